"""What is wrong with a file, said so that its author finds the place and knows what belongs there."""

import difflib
import types
import typing
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ValidationError

Location = tuple[int | str, ...]
QUOTES = "'"


def describe_validation_error(path: Path | str, error: ValidationError, model: type[BaseModel]) -> str:
    """Return one line for each fault that pydantic found: file, key, what was expected, what stood there.

    ``model`` is what the whole file was validated as; from it an unknown key gets the close spelling and the list of
    keys that are allowed in its place.
    """
    return "\n".join(f"{path}: {_describe(fault, model)}" for fault in error.errors(include_url=False))


def _describe(fault: Any, model: type[BaseModel]) -> str:
    location = _as_in_the_file(fault["loc"], model)
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".")
    if fault["type"] == "extra_forbidden":
        return f"{key}: unknown key{_suggestion(str(location[-1]), _allowed_keys(model, fault['loc'][:-1]))}"
    if fault["type"] == "missing":
        return f"{key}: missing"
    if fault["type"] == "union_tag_not_found":
        return f"{key}.{fault['ctx']['discriminator'].strip(QUOTES)}: missing"
    if fault["type"] == "union_tag_invalid":
        key = f"{key}.{fault['ctx']['discriminator'].strip(QUOTES)}"
        return f"{key}: expected one of {fault['ctx']['expected_tags']}, found {fault['ctx']['tag']!r}"
    message = fault["msg"].removeprefix("Value error, ").replace("Input should be ", "expected ")
    found = "" if isinstance(fault["input"], dict) or len(repr(fault["input"])) > 80 else f", found {fault['input']!r}"
    return f"{key}: {message}{found}".removeprefix(": ")


def _suggestion(key: str, allowed: list[str]) -> str:
    if not allowed:
        return ""
    close = difflib.get_close_matches(key, allowed, n=1)
    meant = f"; did you mean {close[0]}?" if close else ";"
    return f"{meant} allowed here: {', '.join(allowed)}"


def _as_in_the_file(location: Location, model: type[BaseModel]) -> Location:
    """Return a fault's place without the names by which pydantic tells the models of a union apart."""
    return tuple(part for i, part in enumerate(location) if _chosen(_type_at(model, location[:i]), part) is None)


def _allowed_keys(model: type[BaseModel], location: Location) -> list[str]:
    """Return the keys of the model that lies at ``location`` inside ``model``."""
    found = _models_in(_type_at(model, location))
    return list(found[0].model_fields) if found else []


def _type_at(model: type[BaseModel], location: Location) -> Any:
    current: Any = model
    for part in location:
        models = _models_in(current)
        chosen = _chosen(current, part)
        if chosen is not None:
            current = chosen
        elif models and isinstance(part, str) and part in models[0].model_fields:
            current = models[0].model_fields[part].annotation
        else:
            # A list's entry by its number, or a table's by its name: the type of the values comes last but for "...".
            arguments = [a for a in typing.get_args(_container_in(current)) if a is not Ellipsis]
            current = arguments[-1] if arguments else None
    return current


def _chosen(annotation: Any, tag: int | str) -> type[BaseModel] | None:
    """Return the model of a union whose ``type`` is ``tag``; None where there is no union to choose from."""
    models = _models_in(annotation)
    if len(models) < 2:
        return None
    return next((m for m in models if tag in typing.get_args(_field_type(m, "type"))), None)


def _field_type(model: type[BaseModel], name: str) -> Any:
    return model.model_fields[name].annotation if name in model.model_fields else None


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    return [a for a in _alternatives(annotation) if isinstance(a, type) and issubclass(a, BaseModel)]


def _container_in(annotation: Any) -> Any:
    return next((a for a in _alternatives(annotation) if typing.get_origin(a) is not None), None)


def _alternatives(annotation: Any) -> list[Any]:
    """Return the types that a union offers, without what validators and None add."""
    origin = typing.get_origin(annotation)
    if origin is Annotated:
        return _alternatives(typing.get_args(annotation)[0])
    if origin in (typing.Union, types.UnionType):
        return [found for argument in typing.get_args(annotation) for found in _alternatives(argument)]
    return [] if annotation is types.NoneType else [annotation]
