"""Handlers that keep what we put into files in order: relative paths, no growing mesh, nothing that was deleted."""

from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..jobs import runner
from .live_mesh import remove_live_meshes
from .originals import forget_deleted, keep_again
from .scene_collection import FOLDER_KEY

_PATHS = {"": ("folder",), "fuse": ("dataset",), "locate": ("color_file", "depth_file")}
"""Settings of a scene that are paths, by their group."""


def _places() -> list[tuple[Any, str]]:
    """Return all our paths in the open file: what has them, and under which name."""
    found: list[tuple[Any, str]] = [
        (block, f'["{FOLDER_KEY}"]')
        for block in bpy.data.collections
        if block.library is None and isinstance(block.get(FOLDER_KEY), str)
    ]
    for scene in _own_scenes():
        for group, names in _PATHS.items():
            found += [(getattr(scene.scanback, group) if group else scene.scanback, name) for name in names]
        found += [(entry, "folder") for entry in scene.scanback.originals]
    return found


def _own_scenes() -> list[bpy.types.Scene]:
    return [scene for scene in bpy.data.scenes if scene.library is None]


def _get(owner: Any, name: str) -> str:
    return str(owner[FOLDER_KEY] if name.startswith("[") else getattr(owner, name))


def _set(owner: Any, name: str, path: str) -> None:
    if name.startswith("["):
        owner[FOLDER_KEY] = path
    elif getattr(owner, name) != path:
        setattr(owner, name, path)


def _make_relative(file: str, absolute: list[tuple[Any, str, str]]) -> None:
    start = file.replace("\\", "/").rpartition("/")[0]
    for owner, name, path in absolute:
        relative = path
        if start:
            try:
                relative = bpy.path.relpath(path, start=start)
            except ValueError:  # on another drive
                relative = path
        _set(owner, name, relative)


def _absolute() -> list[tuple[Any, str, str]]:
    return [(owner, name, bpy.path.abspath(path)) for owner, name in _places() if (path := _get(owner, name))]


_before_saving: list[tuple[Any, str, str]] = []


@persistent  # type: ignore[untyped-decorator]
def _before_save(file: str = "", *_: object) -> None:
    for scene in _own_scenes():
        forget_deleted(scene)
    _before_saving[:] = _absolute()
    if file:
        _make_relative(file, _before_saving)


@persistent  # type: ignore[untyped-decorator]
def _after_save(*_: object) -> None:
    """Make them relative to the file that is open: where a copy was saved, that is another one."""
    _make_relative(bpy.data.filepath, _before_saving)
    _before_saving.clear()


@persistent  # type: ignore[untyped-decorator]
def _remove_what_grew(*_: object) -> None:
    if runner.current_job() is None:
        remove_live_meshes()


@persistent  # type: ignore[untyped-decorator]
def _after_load(*_: object) -> None:
    remove_live_meshes()
    for scene in _own_scenes():
        keep_again(scene)


_HANDLERS = {
    "save_pre": _before_save,
    "save_post": _after_save,
    "save_post_fail": _after_save,
    "undo_post": _remove_what_grew,
    "redo_post": _remove_what_grew,
    "load_post": _after_load,
}


def register() -> None:
    """Add the handlers."""
    for name, handler in _HANDLERS.items():
        getattr(bpy.app.handlers, name).append(handler)


def unregister() -> None:
    """Take them away."""
    for name, handler in _HANDLERS.items():
        getattr(bpy.app.handlers, name).remove(handler)
