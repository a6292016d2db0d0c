"""A .blend file that exists whole or not at all."""

from pathlib import Path

import bpy

from blender_addon.results.scene_collection import FOLDER_KEY
from datagen.atomic_write import replacing
from datagen.errors import InputError


def save_blend(path: Path) -> None:
    """Save the open file to ``path`` atomically, with the reconstruction's folder relative to it.

    Raises InputError where it cannot be written.
    """
    path = path.resolve()
    _make_folders_relative(path.parent)
    _show_colors()
    bpy.context.preferences.filepaths.save_version = 0  # else Blender keeps the empty temporary file as a backup
    with replacing(path) as temporary:
        try:
            bpy.ops.wm.save_as_mainfile(filepath=str(temporary), copy=True, compress=True, check_existing=False)
        except RuntimeError as error:
            raise InputError(f"{path}: Blender cannot write it ({str(error).strip()})") from error


def _make_folders_relative(start: Path) -> None:
    for collection in bpy.data.collections:
        if FOLDER_KEY in collection:
            folder = bpy.path.abspath(collection[FOLDER_KEY])
            collection[FOLDER_KEY] = bpy.path.relpath(folder, start=str(start))


def _show_colors() -> None:
    """Let viewports open in Material Preview, looking through the scene's camera: Solid view shows no scan colours."""
    for screen in bpy.data.screens:
        for area in screen.areas:
            if area.type == "VIEW_3D":
                area.spaces.active.shading.type = "MATERIAL"
                area.spaces.active.region_3d.view_perspective = "CAMERA"
