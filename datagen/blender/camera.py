"""The camera in Blender, and what Blender says its intrinsics and poses are.

Blender's camera looks along its −z with y up, and counts pixels from the image's corner. Both are converted here, once.
"""

import bpy
import numpy as np

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix, rigid
from datagen.scene_spec.camera_settings import CameraSettings

BLENDER_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""The camera's axes: OpenCV's y down and z forward are Blender's −y and −z. It is its own inverse."""


def add_camera(scene: bpy.types.Scene, settings: CameraSettings) -> bpy.types.Object:
    """Add a perspective camera to ``scene`` and make it the one that renders.

    Depth of field stays off: it would blur depth together with the colours.
    """
    data = bpy.data.cameras.new("Camera")
    data.type = "PERSP"
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = settings.sensor_width_mm
    data.lens = settings.focal_length_mm
    data.clip_start = settings.clip_start
    data.clip_end = settings.clip_end
    camera = bpy.data.objects.new("Camera", data)
    scene.collection.objects.link(camera)
    scene.camera = camera
    return camera


def read_intrinsics(scene: bpy.types.Scene) -> PinholeCamera:
    """Return the intrinsics of the scene's camera at its render size, from Blender's own projection matrix.

    The matrix maps Blender's camera axes to [-1, 1] across the image (OpenGL's clip space); single precision, so
    that the numbers hold to 1e-7.
    """
    width, height = scene.render.resolution_x, scene.render.resolution_y
    clip_from_camera = np.array(
        scene.camera.calc_matrix_camera(
            bpy.context.evaluated_depsgraph_get(),
            x=width,
            y=height,
            scale_x=scene.render.pixel_aspect_x,
            scale_y=scene.render.pixel_aspect_y,
        ),
        dtype=np.float64,
    )
    return PinholeCamera.from_corner_origin(
        width=width,
        height=height,
        fx=clip_from_camera[0, 0] * width / 2,
        fy=clip_from_camera[1, 1] * height / 2,
        cx=(1 - clip_from_camera[0, 2]) * width / 2,
        cy=(1 + clip_from_camera[1, 2]) * height / 2,
    )


def read_pose(scene: bpy.types.Scene) -> Matrix:
    """Return world_from_camera, OpenCV axes, of the scene's camera as Blender evaluates it at the current frame."""
    evaluated = scene.camera.evaluated_get(bpy.context.evaluated_depsgraph_get())
    world_from_blender = np.array(evaluated.matrix_world, dtype=np.float64)
    return rigid(world_from_blender @ BLENDER_FROM_OPENCV, source=f"Blender's camera at frame {scene.frame_current}")
