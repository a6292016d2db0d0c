"""A scan of a scene in centimetres and inches: an object turned, mirrored, sheared and smoothed by a modifier.

It is made once, by the four steps themselves; each test has a copy, opened in Blender.
"""

import json
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from tick_time import timing_ticks

from blender_addon.jobs import runner
from blender_addon.jobs.job import Pace
from blender_addon.results.scene_collection import LIVE_PART, PART_KEY
from blender_addon.settings import FuseProperties
from blender_addon.steps import reasons
from blender_addon.steps.evaluation import evaluated_as_shown
from blender_addon.steps.fuse import fuse_work
from blender_addon.steps.scene_reference import remember

VOXEL = 0.06
UNIT = 0.01
"""Metres in a unit of the scene, which has centimetres under inches and feet."""
BLEND, FOLDER, SEEN = "project.blend", "scan", "seen.json"


@dataclass(frozen=True)
class Project:
    """A scanned and fused scene that is open in Blender; ``seen`` is what was seen as it was fused."""

    folder: Path
    seen: dict[str, Any]
    voxel: float = VOXEL
    unit: float = UNIT

    def offsets(self, points: np.ndarray) -> np.ndarray:
        """Return how far points (N, 3) of the scene are from the original, by Blender's own nearest point."""
        original = bpy.data.objects["Original"]
        offsets = []
        with evaluated_as_shown([original]) as depsgraph:  # it is hidden behind its reconstruction
            shown = original.evaluated_get(depsgraph)
            world_from_object = np.array(shown.matrix_world)
            object_from_world = np.linalg.inv(world_from_object)
            for point in points @ object_from_world[:3, :3].T + object_from_world[:3, 3]:
                found, place, _, _ = shown.closest_point_on_mesh(tuple(map(float, point)))
                assert found
                offsets.append(np.linalg.norm(world_from_object[:3, :3] @ (np.array(place) - point)))
        return np.array(offsets)


def make_project(place: Path) -> None:
    """Scan and fuse into the folder ``place``, with the extension registered and any file open."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = _scene()
    folder = place / FOLDER
    options = {"frames": 10, "preset": "draft", "trajectory": "HEMISPHERE", "width": 64, "height": 48}
    assert bpy.ops.scanback.scan(folder=str(folder), **options) == {"FINISHED"}
    scene.scanback.folder = str(folder)
    seen = _fuse_as_the_button_does(folder)
    bpy.ops.wm.save_as_mainfile(filepath=str(place / BLEND))
    (place / SEEN).write_text(json.dumps(seen))


def open_copy(made: Path, place: Path) -> Project:
    """Copy a project that was made to the folder ``place`` and open it there."""
    shutil.copytree(made, place, dirs_exist_ok=True)
    bpy.ops.wm.open_mainfile(filepath=str(place / BLEND))
    return Project(place / FOLDER, json.loads((place / SEEN).read_bytes()))


def _scene() -> bpy.types.Scene:
    scene = bpy.context.scene
    scene.unit_settings.system = "IMPERIAL"
    scene.unit_settings.scale_length = UNIT
    bpy.ops.mesh.primitive_monkey_add(size=1.5, location=(0.4, -0.3, 0.2))
    head = bpy.context.active_object
    head.name = "Original"
    head.rotation_euler = (0.3, 0.2, 1.0)
    head.scale = (-1.5, 0.8, 1.1)
    parent = bpy.data.objects.new("Parent", None)
    scene.collection.objects.link(parent)
    parent.location, parent.rotation_euler, parent.scale = (0.2, 0.1, 0.4), (0.1, -0.5, 0.2), (1.0, 1.3, 0.9)
    head.parent = parent
    modifier = head.modifiers.new("Subdivision", "SUBSURF")
    modifier.levels = modifier.render_levels = 1
    return scene


def _fuse_as_the_button_does(folder: Path) -> dict[str, Any]:
    """The button begins the job and returns; ticks do the rest. Returns what was seen between them.

    Without a window Blender invokes no operators: what the button's does is done here.
    """
    settings = bpy.context.scene.scanback.fuse
    settings.voxel_size, settings.every, settings.device = VOXEL, 2, "cpu"
    seen: dict[str, Any] = {"why not before": reasons.why_not_fuse(bpy.context)}
    chosen = {name: getattr(settings, name) for name in FuseProperties.__annotations__}
    job = runner.start("Fuse", fuse_work(remember(bpy.context.scene), folder, folder / "dataset", chosen))
    seen["why not meanwhile"] = reasons.why_not_fuse(bpy.context)
    original = bpy.data.objects["Original"]
    seen["shown before"] = original.visible_get()
    stages, grew, flickered = set(), False, False
    with timing_ticks() as ticks:
        while not job.is_over:
            pace = ticks.of(runner.advance)
            stages.add(job.log.stage)
            grows = any(item.get(PART_KEY) == LIVE_PART for item in bpy.data.objects)
            flickered = flickered or (grows and (original.visible_get() or not original.hide_render))
            grew = grew or grows
            time.sleep(0.005 if pace is Pace.WAIT else 0)
    seen |= {"state": job.state.value, "message": job.message, "log": list(job.log.lines), "stages": sorted(stages)}
    seen |= {"longest": ticks.longest, "grew": grew, "flickered": flickered}
    return seen
