"""From the camera of the files to Blender's: the one place where axes, principal point and half pixel change.

The files have OpenCV axes (x right, y down, z forward) and integer pixel centres; Blender has x right, y up, z
backward, and measures from the image's corner, where pixel centres lie at +0.5.
"""

from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Matrix

from ..files.reconstruction_files import Intrinsics, Pose

SENSOR_WIDTH_MM = 36.0
LENS_MIN_MM = 1.0
"""Blender takes no shorter lens; a wider view needs a wider sensor."""
CAMERA_OPENCV_FROM_BLENDER = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class BlenderIntrinsics:
    """A pinhole camera in Blender's terms, for a horizontal sensor fit; the pixel aspect belongs to the render."""

    sensor_width_mm: float
    lens_mm: float
    shift_x: float
    shift_y: float
    pixel_aspect_x: float
    pixel_aspect_y: float


def blender_intrinsics(camera: Intrinsics) -> BlenderIntrinsics:
    """Return Blender's settings that project as ``camera`` does.

    With a horizontal fit, u + ½ = W/2 + (x/z · lens/sensor − shift_x)·W and, pixels being fx/fy times as high as
    wide, v + ½ = H/2 + (y/z · lens/sensor + shift_y)·W·fy/fx, where y points down.
    """
    sensor_width_mm = max(SENSOR_WIDTH_MM, LENS_MIN_MM * camera.width / camera.fx)
    height_over_width = camera.fx / camera.fy
    corner_cx, corner_cy = camera.cx + 0.5, camera.cy + 0.5
    return BlenderIntrinsics(
        sensor_width_mm=sensor_width_mm,
        lens_mm=camera.fx / camera.width * sensor_width_mm,
        shift_x=(camera.width / 2 - corner_cx) / camera.width,
        shift_y=(corner_cy - camera.height / 2) / camera.width * height_over_width,
        # Blender clamps an aspect below 1, so the larger side carries the ratio.
        pixel_aspect_x=max(1.0, 1 / height_over_width),
        pixel_aspect_y=max(1.0, height_over_width),
    )


def set_intrinsics(camera_data: bpy.types.Camera, camera: Intrinsics) -> None:
    """Make a Blender camera project as ``camera`` does, in a render of its size and pixel aspect."""
    blender = blender_intrinsics(camera)
    camera_data.type = "PERSP"
    camera_data.sensor_fit = "HORIZONTAL"
    camera_data.sensor_width = blender.sensor_width_mm
    camera_data.lens = blender.lens_mm
    camera_data.shift_x = blender.shift_x
    camera_data.shift_y = blender.shift_y


def set_render_size(render: bpy.types.RenderSettings, camera: Intrinsics) -> None:
    """Give a scene's renders the size and pixel aspect of ``camera``'s images."""
    blender = blender_intrinsics(camera)
    render.resolution_x = camera.width
    render.resolution_y = camera.height
    render.resolution_percentage = 100
    render.pixel_aspect_x = blender.pixel_aspect_x
    render.pixel_aspect_y = blender.pixel_aspect_y


def blender_pose(world_from_camera: Pose) -> Matrix:
    """Return the world matrix of a Blender camera that looks as the OpenCV pose (4×4) says."""
    return Matrix((world_from_camera @ CAMERA_OPENCV_FROM_BLENDER).tolist())
