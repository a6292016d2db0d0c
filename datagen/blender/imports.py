"""Model files brought into Blender: read in an emptied Blender, frozen, and kept as a library that scenes append from.

Whatever a foreign file brings along (scripts, handlers, settings) stays behind with the Blender it was read into.
"""

from pathlib import Path

import bpy

from datagen.blender.finite import require_finite
from datagen.blender.freeze import FROZEN_INDEX, freeze_scene
from datagen.blender.opaque import require_textures
from datagen.errors import InputError
from datagen.scene_spec.objects import SUFFIXES_WITHOUT_AXES

UP_AXIS_OF_OBJ = "y"


def prepare_file(
    path: Path, library: Path, *, up_axis: str | None = None, keep_materials: bool = True, frame: int | None = None
) -> None:
    """Read a model file and write what of it is rendered, as plain meshes with their materials, into ``library``.

    Of a .blend that is what stands there at ``frame`` (None: its first one), with lights, world and camera. Blender is
    emptied. Raises InputError where the file is missing, damaged, of no known format, or shows no surface.
    """
    frozen = read_and_freeze(path, up_axis=up_axis, frame=frame)
    if keep_materials:
        require_textures(path)
    bpy.data.libraries.write(str(library), frozen, path_remap="ABSOLUTE")


def read_and_freeze(path: Path, *, up_axis: str | None = None, frame: int | None = None) -> set[bpy.types.ID]:
    """Read a model file into an emptied Blender and freeze it there (see ``freeze_scene``)."""
    if not path.is_file():
        raise InputError(f"{path}: the file is missing; name a model file")
    if path.suffix.lower() == ".blend":
        _open_blend(path)
    else:
        require_finite(path)
        bpy.ops.wm.read_factory_settings(use_empty=True)
        _import(path, up_axis)
    return freeze_scene(bpy.context.scene, source=path, frame=frame)


def append_models(scene: bpy.types.Scene, library: Path) -> list[bpy.types.Object]:
    """Append the meshes of a prepared ``library`` to ``scene`` and return them; lights and cameras stay behind."""
    with bpy.data.libraries.load(str(library), link=False) as (there, wanted):
        wanted.objects = list(there.objects)
    models = []
    for thing in wanted.objects:
        if thing.type == "MESH":
            scene.collection.objects.link(thing)
            models.append(thing)
        else:
            bpy.data.objects.remove(thing)
    return sorted(models, key=lambda model: int(model[FROZEN_INDEX]))


def _open_blend(path: Path) -> None:
    """Open a .blend without letting it run anything: neither its registered text blocks nor Python in its drivers."""
    try:
        bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False, use_scripts=False)
    except RuntimeError as error:
        raise InputError(f"{path}: no .blend that Blender can open ({_reason(error)}); save it anew") from error
    missing = [library.filepath for library in bpy.data.libraries if not Path(_absolute(library.filepath)).is_file()]
    if missing:
        raise InputError(f"{path}: links to {missing[0]}, which is missing; put it there, or make all local and save")


def _import(path: Path, up_axis: str | None) -> None:
    kind = path.suffix.lower()
    file = str(path)
    # Formats that do not say which axis points up are read as they are, and turned here if it is y.
    up = up_axis or (UP_AXIS_OF_OBJ if kind == ".obj" else "z")
    axes = {"forward_axis": "NEGATIVE_Z", "up_axis": "Y"} if up == "y" else {"forward_axis": "Y", "up_axis": "Z"}
    try:
        if kind == ".obj":
            bpy.ops.wm.obj_import(filepath=file, **axes)
        elif kind == ".ply":
            bpy.ops.wm.ply_import(filepath=file, import_colors="SRGB", **axes)
        elif kind == ".stl":
            bpy.ops.wm.stl_import(filepath=file, **axes)
        elif kind in (".glb", ".gltf"):
            bpy.ops.import_scene.gltf(filepath=file)
        elif kind.startswith(".usd"):
            bpy.ops.wm.usd_import(filepath=file, import_lights=False, import_cameras=False)
        else:
            raise InputError(f"{path}: no known format of models")
    except RuntimeError as error:
        raise InputError(f"{path}: no {kind} that Blender can read ({_reason(error)}); export it anew") from error
    if not bpy.data.objects:
        without = " or its axes" if kind in SUFFIXES_WITHOUT_AXES else ""
        raise InputError(
            f"{path}: Blender finds nothing in it; check that it is a {kind} file{without}, export it anew"
        )


def _absolute(path: str) -> str:
    return bpy.path.abspath(path)


def _reason(error: RuntimeError) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1].removeprefix("Error: ") if lines else "it does not say why"
