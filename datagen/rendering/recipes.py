"""Recipes: all that decides what a dataset's frames show, as ``dataset.json`` has it."""

import json
from typing import Any

from pydantic import ValidationError

from datagen.scene_spec.model_files import portable
from datagen.scene_spec.scene import Scene

IRRELEVANT_TO_FRAMES = {"description"}


def recipe_of(scene: Scene) -> dict[str, Any]:
    """Return all that decides what a dataset's frames show, ready for JSON; models by name and SHA-256."""
    return portable(scene.model_dump(mode="json", exclude=IRRELEVANT_TO_FRAMES))


def with_defaults(recipe: dict[str, Any]) -> dict[str, Any]:
    """Return a stored recipe with the settings that came into being after it, where it is one of ours at all."""
    try:
        return recipe_of(Scene.model_validate_json(json.dumps(recipe)))
    except ValidationError:
        return recipe


def first_difference(there: Any, wanted: Any, key: str = "") -> tuple[str, Any, Any] | None:
    """Return the key at which two recipes first differ, and what each has there (None: nothing)."""
    if isinstance(there, dict) and isinstance(wanted, dict):
        pairs = [(f"{key}.{name}".lstrip("."), name) for name in dict.fromkeys([*wanted, *there])]
        found = (first_difference(there.get(name), wanted.get(name), path) for path, name in pairs)
    elif isinstance(there, list) and isinstance(wanted, list) and len(there) == len(wanted):
        found = (first_difference(a, b, f"{key}[{i}]") for i, (a, b) in enumerate(zip(there, wanted, strict=True)))
    else:
        return None if there == wanted else (key, there, wanted)
    return next((difference for difference in found if difference is not None), None)
