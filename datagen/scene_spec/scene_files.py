"""Finding and reading scene files."""

import difflib
import json
import tomllib
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from datagen.errors import InputError
from datagen.pydantic_errors import describe_validation_error
from datagen.scene_spec.measured_model import measure_model
from datagen.scene_spec.model_files import locate_models
from datagen.scene_spec.model_scene import own_camera, scene_of_model
from datagen.scene_spec.objects import MODEL_SUFFIXES
from datagen.scene_spec.render_settings import RenderSettings
from datagen.scene_spec.scene import Scene
from datagen.trajectory.pose_files import locate_recording

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
    """Read a scene that comes with the program, by its name, or any other by its path; or put a model on a stage.

    Raises InputError where there is no such scene, and for every fault in it.
    """
    path = Path(name_or_path)
    if path.suffix.lower() in MODEL_SUFFIXES:
        return _validated(path, scene_of_model(path), folder=Path())
    if path.suffix == SUFFIX or path.parent != Path():
        return read_scene(path)
    shipped = scenes_folder() / f"{name_or_path}{SUFFIX}"
    if not shipped.is_file():
        names = shipped_scenes()
        close = difflib.get_close_matches(name_or_path, names, n=1)
        meant = f"did you mean {close[0]}? " if close else ""
        raise InputError(
            f"{name_or_path}: no scene of this name; {meant}there are: {', '.join(names)}; "
            f"or name a scene file, ending in {SUFFIX}, or a model: {', '.join(MODEL_SUFFIXES)}"
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
    return _validated(path, _with_own_camera(content, path.parent), folder=path.parent)


def _with_own_camera(content: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the content with a .blend's own camera where it says nothing of a camera's motion, or asks for that."""
    blend, trajectory = content.get("blend"), content.get("trajectory")
    if not isinstance(blend, dict) or not isinstance(blend.get("file"), str) or "keyframes" in content:
        return content
    if trajectory is not None and not (isinstance(trajectory, dict) and trajectory.get("type") == "blend-camera"):
        return content
    path = (folder / Path(blend["file"]).expanduser()).resolve()
    measured = measure_model(path)
    if measured.camera is None:
        raise InputError(f"{path}: has no camera; set its active camera, or give keyframes or a trajectory")
    own = own_camera(measured)
    # What the scene file says itself stands.
    tables = {key: own[key] | content.get(key, {}) for key in ("render", "trajectory")}
    return own | content | tables


def _validated(path: Path, content: dict[str, Any], *, folder: Path) -> Scene:
    try:
        # Through JSON, because a strict model takes a JSON array for a tuple but not a Python list.
        located = locate_recording(locate_models(content, folder), folder)
        return Scene.model_validate_json(json.dumps(located, default=str))
    except ValidationError as error:
        raise InputError(describe_validation_error(path, error, Scene)) from error


def with_render_settings(scene: Scene, **changes: Any) -> Scene:
    """Return the scene with some of its render settings replaced. Raises InputError for a value out of range."""
    try:
        render = RenderSettings.model_validate(scene.render.model_dump() | changes)
    except ValidationError as error:
        raise InputError(describe_validation_error("render settings", error, RenderSettings)) from error
    return scene.model_copy(update={"render": render})
