"""One camera of a reconstruction through which its fused frames are looked at, one after the other."""

from collections.abc import Sequence

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from ..errors import ReconstructionError
from ..files.dataset_files import color_file
from ..files.reconstruction_files import Record
from .camera_conversion import blender_pose
from .frame_pictures import show_behind
from .scan_camera import new_scan_camera
from .scene_collection import MESH_PART, VIEW_PART, add_part, marker_size, parts

FRAME, RANKING = "frame", "nearest_frames"
"""Custom properties of the camera: the frame that it shows, and those to step through, nearest first."""
MOST_RANKED = 100
REACHED = 0.02
"""A ray that stops within this share of the way has reached the point."""


def look_through(
    scene: bpy.types.Scene, collection: bpy.types.Collection, record: Record, frame: int, ranking: Sequence[int]
) -> bpy.types.Object:
    """Put the looking camera of a reconstruction at a fused frame, with its picture behind, and make it the scene's.

    Raises ReconstructionError where the frame was not fused.
    """
    poses = {fused.frame: fused.world_from_camera for fused in record.trajectory}
    if frame not in poses:
        raise ReconstructionError(f"Frame {frame} is not one of those that were fused; import the reconstruction again")
    camera = view_camera(collection)
    if camera is None:
        camera = new_scan_camera("Scanback view", record.intrinsics, size=marker_size(collection))
        add_part(collection, VIEW_PART, [camera])
    camera.matrix_world = blender_pose(poses[frame])
    camera.data.name = f"Frame {frame}"
    camera.name = f"Frame {frame}"
    camera[FRAME], camera[RANKING] = frame, list(ranking)[:MOST_RANKED]
    show_behind(camera.data, color_file(record.dataset, frame))
    scene.camera = camera
    return camera


def view_camera(collection: bpy.types.Collection) -> bpy.types.Object | None:
    """Return the looking camera of a reconstruction, None where there is none."""
    return next((item for item in parts(collection, VIEW_PART) if item.type == "CAMERA"), None)


def neighbour(camera: bpy.types.Object, step: int) -> int | None:
    """Return the frame that is ``step`` places after the one shown in the order of nearness, None beyond its ends."""
    ranking = [int(frame) for frame in camera.get(RANKING, ())]
    if camera.get(FRAME) not in ranking:
        return None
    place = ranking.index(camera[FRAME]) + step
    return ranking[place] if 0 <= place < len(ranking) else None


def point_is_visible(
    collection: bpy.types.Collection, point_world: NDArray[np.float64], position_world: NDArray[np.float64]
) -> bool:
    """Tell whether the reconstruction's mesh leaves the way from a position to a point free."""
    way = Vector(point_world) - Vector(position_world)
    for item in parts(collection, MESH_PART):
        object_from_world = item.matrix_world.inverted_safe()
        start, direction = object_from_world @ Vector(position_world), object_from_world.to_3x3() @ way
        if not direction.length or not item.data.polygons:
            continue
        if item.ray_cast(start, direction.normalized(), distance=direction.length * (1 - REACHED))[0]:
            return False
    return True
