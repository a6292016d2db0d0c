"""The folder of a scene's scan, and what lies where in it."""

import contextlib
from pathlib import Path
from typing import Any

import bpy

from .preferences import cache_folder

DATASET, RECONSTRUCTION, SOURCE = "dataset", "reconstruction", "source"
"""Folders within the folder of a scene's scan."""


def scan_folder(scene: Any, given: str = "") -> Path:
    """Return the folder of a scene's scan: as given, as set, beside the .blend file, or in the cache."""
    named = given or scene.scanback.folder
    blend, unsaved = bpy.data.filepath, cache_folder() / "unsaved" / (scene.scanback.token or "scene")
    if named.startswith("//") and not blend:
        return (unsaved / named[2:]).resolve()  # there is no file yet that it could lie beside
    if named:
        return Path(bpy.path.abspath(named)).resolve()
    return Path(blend).resolve().with_name(f"{Path(blend).stem}_scanback{_among_scenes(scene)}") if blend else unsaved


def _among_scenes(scene: Any) -> str:
    """Return what tells a scene from the others of its file, in a file name; empty where it is the only one."""
    own = [other for other in bpy.data.scenes if other.library is None]
    return f"_{bpy.path.clean_name(scene.name)}" if len(own) > 1 else ""


def settle_folder(scene: Any, given: str = "") -> Path:
    """Return the folder of a scene's scan as above, and let it stay that: something is written there now.

    The place that an empty setting stands for moves with the file and its scenes.
    """
    folder = scan_folder(scene, given)
    if not (given or scene.scanback.folder):
        scene.scanback.folder = relative_path(folder)
    return folder


def relative_path(path: Path) -> str:
    """Return a path as it is kept in the open file: relative to it where it was saved."""
    if bpy.data.filepath:
        with contextlib.suppress(ValueError):  # another drive
            return str(bpy.path.relpath(str(path)))
    return str(path)
