"""A declared scene made in Blender; the camera comes apart."""

import tempfile
from pathlib import Path

import bpy

from datagen.blender.blend_file import append_blend
from datagen.blender.imports import prepare_file
from datagen.blender.lights import add_light, set_world
from datagen.blender.materials import add_material
from datagen.blender.objects import add_object
from datagen.scene_spec.objects import PartSettings
from datagen.scene_spec.scene import Scene


def build_scene(spec: Scene) -> bpy.types.Scene:
    """Empty Blender and make the objects, materials, lights and world of ``spec`` in it.

    The pass index of an object is its place in the scene file's list, from 1; those of a .blend follow, in the order
    of their names. Where the .blend has a camera, that is the scene's. Raises InputError for files that are no use.
    """
    with tempfile.TemporaryDirectory(prefix="scanback-models-") as folder:
        # Files are read one by one into an emptied Blender, so all of them before the scene is begun.
        libraries = _prepare_files(spec, Path(folder))
        blend_library = Path(folder) / "blend.blend"
        if spec.blend is not None:
            prepare_file(Path(spec.blend.file), blend_library, frame=spec.blend.frame)
        bpy.ops.wm.read_factory_settings(use_empty=True)
        scene = bpy.context.scene
        scene.name = spec.name
        set_world(scene, spec.world)
        if spec.blend is not None:
            append_blend(scene, blend_library, spec.blend, first_index=len(spec.objects) + 1)
        materials = {name: add_material(name, settings) for name, settings in spec.materials.items()}
        for number, settings in enumerate(spec.objects):
            add_object(
                scene,
                settings,
                index=number + 1,
                materials=materials,
                declared=spec.materials,
                libraries=libraries,
            )
    for number, light in enumerate(spec.lights):
        add_light(scene, light, name=f"{light.type}.{number}")
    bpy.context.view_layer.update()
    return scene


def _prepare_files(spec: Scene, folder: Path) -> dict[PartSettings, Path]:
    libraries: dict[PartSettings, Path] = {}
    prepared: dict[tuple[str | None, str | None], Path] = {}
    for part in (part for settings in spec.objects for part in settings.all_parts if part.file is not None):
        key = (part.file, part.up_axis)
        if key not in prepared:
            prepared[key] = folder / f"model-{len(prepared)}.blend"
            prepare_file(
                Path(str(part.file)), prepared[key], up_axis=part.up_axis, keep_materials=part.material is None
            )
        libraries[part] = prepared[key]
    return libraries
