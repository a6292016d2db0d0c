"""What is wrong with a file, said so that its author finds the place and knows what belongs there."""

import difflib
import types
import typing
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError


def describe_validation_error(path: Path | str, error: ValidationError, model: type[BaseModel]) -> str:
    """Return one line for each fault that pydantic found: file, key, what was expected, what stood there.

    ``model`` is what the whole file was validated as; from it an unknown key gets the close spelling and the list of
    keys that are allowed in its place.
    """
    return "\n".join(f"{path}: {_describe(fault, model)}" for fault in error.errors(include_url=False))


def _describe(fault: Any, model: type[BaseModel]) -> str:
    location = fault["loc"]
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".")
    if fault["type"] == "extra_forbidden":
        return f"{key}: unknown key{_suggestion(str(location[-1]), _allowed_keys(model, location[:-1]))}"
    if fault["type"] == "missing":
        return f"{key}: missing"
    message = fault["msg"].removeprefix("Value error, ").replace("Input should be ", "expected ")
    found = "" if isinstance(fault["input"], dict) or len(repr(fault["input"])) > 80 else f", found {fault['input']!r}"
    return f"{key}: {message}{found}".removeprefix(": ")


def _suggestion(key: str, allowed: list[str]) -> str:
    if not allowed:
        return ""
    close = difflib.get_close_matches(key, allowed, n=1)
    meant = f"; did you mean {close[0]}?" if close else ";"
    return f"{meant} allowed here: {', '.join(allowed)}"


def _allowed_keys(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """Return the keys of the model that lies at ``location`` inside ``model``."""
    current: Any = model
    for part in location:
        found = _model_in(current)
        if found is not None and isinstance(part, str) and part in found.model_fields:
            current = found.model_fields[part].annotation
        elif typing.get_args(current):
            # A list's entry by its number, or a table's by its name: the type of the values comes last but for "...".
            current = [argument for argument in typing.get_args(current) if argument is not Ellipsis][-1]
    found = _model_in(current)
    return list(found.model_fields) if found is not None else []


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return next((found for a in typing.get_args(annotation) if (found := _model_in(a)) is not None), None)
    return None
