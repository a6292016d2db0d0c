"""Located frames as cameras at their nearest poses, each with a wire frustum that renders."""

from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np

from ..files.dataset_files import color_file
from ..files.reconstruction_files import Intrinsics, LocatedFrame, Pose
from .camera_conversion import CAMERA_OPENCV_FROM_BLENDER, blender_pose
from .emission_material import colored_wire
from .frame_pictures import show_behind
from .scan_camera import new_scan_camera
from .wire_curve import create_wire, render_as_tubes

MARKER_COLOR_LINEAR = (0.9, 0.17, 0.0)
FRUSTUM_MARGIN = 1.08
"""The frustum is this much wider than the view, so that the marker's own camera does not see it."""


def create_markers(
    located: Sequence[LocatedFrame], intrinsics: Intrinsics, *, dataset: Path, size: float, radius: float
) -> list[bpy.types.Object]:
    """Return new camera objects, one for each located frame, and their frusta, which share one curve.

    ``size`` is how far a frustum reaches, ``radius`` half the thickness of its lines, in the scene's units, as poses
    are. The cameras carry query, nearest, score and, where the truth is known, the errors as custom properties, and
    show the nearest frame of ``dataset`` behind what they see. A pose that was refined has a camera of its own.
    """
    if not located:
        return []
    material = colored_wire("Scanback marker", MARKER_COLOR_LINEAR)
    frustum = _create_frustum(intrinsics, size=size)
    markers = []
    for frame in located:
        camera = _create_camera(frame, intrinsics, size=size)
        show_behind(camera.data, color_file(dataset, frame.nearest))
        wire = bpy.data.objects.new(f"{camera.name} frustum", frustum)
        wire.parent = camera
        render_as_tubes(wire, radius=radius, material=material)
        wire.hide_select = True  # a click on it is meant for the camera
        markers += [camera, wire]
        if frame.refined is not None:
            markers.append(_create_refined(frame, frame.refined, intrinsics, size=size))
    return markers


def _create_camera(frame: LocatedFrame, intrinsics: Intrinsics, *, size: float) -> bpy.types.Object:
    name = f"Query {frame.query} nearest {frame.nearest}"
    camera = new_scan_camera(name, intrinsics, size=size)
    camera.matrix_world = blender_pose(frame.world_from_camera)
    camera["query"] = frame.query
    camera["nearest"] = frame.nearest
    camera["nearest_frames"] = list(frame.nearest_frames)
    if frame.score is not None:
        camera["score"] = frame.score
    if frame.rotation_error_deg is not None:
        camera["rotation_error_deg"] = frame.rotation_error_deg
    if frame.translation_error_m is not None:
        camera["translation_error_m"] = frame.translation_error_m
    return camera


def _create_refined(
    frame: LocatedFrame, world_from_camera: Pose, intrinsics: Intrinsics, *, size: float
) -> bpy.types.Object:
    camera = new_scan_camera(f"Query {frame.query} refined", intrinsics, size=size)
    camera.matrix_world = blender_pose(world_from_camera)
    camera["query"] = frame.query
    camera["nearest"] = frame.nearest
    camera["nearest_frames"] = list(frame.nearest_frames)
    camera["verdict"] = frame.verdict or ""
    return camera


def _create_frustum(camera: Intrinsics, *, size: float) -> bpy.types.Curve:
    """Return the curve of a view pyramid of depth ``size`` in the frame of a Blender camera."""
    corners_px = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * (camera.width, camera.height) - 0.5
    rays = (corners_px - (camera.cx, camera.cy)) / (camera.fx, camera.fy) * FRUSTUM_MARGIN
    corners_opencv = np.column_stack([rays, np.ones(4)]) * size
    corners = corners_opencv @ CAMERA_OPENCV_FROM_BLENDER[:3, :3]
    apex = np.zeros(3)
    top = corners[:2] + (corners[:2] - corners[3:1:-1]) * 0.12
    roof = np.stack([corners[0], top.mean(axis=0), corners[1]])
    return create_wire(
        "Scanback frustum",
        [corners, *(np.stack([apex, corner]) for corner in corners), roof],
        closed=[True, False, False, False, False, False],
    )
