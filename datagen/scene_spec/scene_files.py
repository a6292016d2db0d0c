"""Finding and reading scene files."""

import difflib
import json
import tomllib
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from datagen.errors import InputError
from datagen.pydantic_errors import describe_validation_error
from datagen.scene_spec.render_settings import RenderSettings
from datagen.scene_spec.scene import Scene

SUFFIX = ".toml"


def scenes_folder() -> Path:
    """Return the folder of the scenes that come with the program.

    An installed package carries them inside itself; in a source checkout they lie beside the package.
    """
    package = Path(__file__).resolve().parents[1]
    installed = package / "scenes"
    return installed if installed.is_dir() else package.parent / "scenes"


def shipped_scenes() -> list[str]:
    """Return the names of the scenes that come with the program."""
    return sorted(path.stem for path in scenes_folder().glob(f"*{SUFFIX}"))


def load_scene(name_or_path: str) -> Scene:
    """Read a scene that comes with the program, by its name, or any other by its path.

    Raises InputError where there is no such scene, and for every fault in it.
    """
    path = Path(name_or_path)
    if path.suffix == SUFFIX or path.parent != Path():
        return read_scene(path)
    shipped = scenes_folder() / f"{name_or_path}{SUFFIX}"
    if not shipped.is_file():
        names = shipped_scenes()
        close = difflib.get_close_matches(name_or_path, names, n=1)
        meant = f"did you mean {close[0]}? " if close else ""
        raise InputError(
            f"{name_or_path}: no scene of this name; {meant}there are: {', '.join(names)}; "
            f"or name a scene file, ending in {SUFFIX}"
        )
    return read_scene(shipped)


def read_scene(path: Path) -> Scene:
    """Read and check a scene file. Raises InputError naming the file and the line or key of each fault."""
    try:
        with path.open("rb") as file:
            content = tomllib.load(file)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML: {error}") from error
    try:
        # Through JSON, because a strict model takes a JSON array for a tuple but not a Python list.
        return Scene.model_validate_json(json.dumps(content, default=str))
    except ValidationError as error:
        raise InputError(describe_validation_error(path, error, Scene)) from error


def with_render_settings(scene: Scene, **changes: Any) -> Scene:
    """Return the scene with some of its render settings replaced. Raises InputError for a value out of range."""
    try:
        render = RenderSettings.model_validate(scene.render.model_dump() | changes)
    except ValidationError as error:
        raise InputError(describe_validation_error("render settings", error, RenderSettings)) from error
    return scene.model_copy(update={"render": render})
