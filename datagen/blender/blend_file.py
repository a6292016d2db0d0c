"""A prepared .blend put into a scene: its surfaces, lights, world and camera."""

from pathlib import Path

import bpy

from datagen.blender.freeze import FIRST_FRAME, FROZEN_INDEX, FROZEN_NAME, LAST_FRAME
from datagen.scene_spec.blend_settings import BlendSettings


def append_blend(scene: bpy.types.Scene, library: Path, settings: BlendSettings, *, first_index: int) -> None:
    """Append what ``library`` has (see ``imports.prepare_file``) to ``scene``.

    Pass indices count from ``first_index`` in the order of the objects' names. The .blend's camera, with its motion
    and its frame range, becomes the scene's.
    """
    with bpy.data.libraries.load(str(library), link=False) as (there, wanted):
        wanted.objects = list(there.objects)
        wanted.worlds = list(there.worlds) if settings.world else []
    for thing in wanted.objects:
        if thing.type == "LIGHT" and not settings.lights:
            continue
        scene.collection.objects.link(thing)
        thing.name = thing[FROZEN_NAME]
        if thing.type == "MESH":
            thing.pass_index = first_index + int(thing[FROZEN_INDEX])
        elif thing.type == "CAMERA":
            scene.camera = thing
            scene.frame_start, scene.frame_end = int(thing[FIRST_FRAME]), int(thing[LAST_FRAME])
    if wanted.worlds:
        scene.world = wanted.worlds[0]
