"""The camera in Blender, and what Blender says its intrinsics and poses are.

Blender's camera looks along its −z with y up, and counts pixels from the image's corner. Both are converted here, once.

Cycles' first sample of a pixel, which depth comes from, lies a constant fraction of a pixel right of and above the
pixel's centre. The camera is shifted by as much, so that the first sample goes through the centre and depth is exact.
"""

import bpy
import numpy as np

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix, rigid
from datagen.scene_spec.camera_settings import CameraSettings

BLENDER_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""The camera's axes: OpenCV's y down and z forward are Blender's −y and −z. It is its own inverse."""

FILTER_WIDTH_PX = 1.5
"""Of the Blackman-Harris pixel filter, Cycles' default."""

FIRST_SAMPLE_PX = 0.35875 * FILTER_WIDTH_PX / 1022
"""How far right of and above the pixel's centre Cycles takes its first sample: 0.00053 pixels.

The filter is sampled through a table of 1024 entries that is symmetric about entry 511, and the first sample looks it
up at its middle, 511.5. Half an entry there is 1/1022 of the filter's weight, and so 1/1022 of its width over the
filter's peak density; 0.35875 is the mean of the Blackman-Harris window, of peak 1.
"""

_SHIFTED_PX = "first_sample_px"
_SENSOR_MM = 36.0
_LENS_RANGE_MM = (1.0, 5000.0)


def add_camera(scene: bpy.types.Scene, settings: CameraSettings) -> bpy.types.Object:
    """Add a perspective camera to ``scene``, whose image size is set, and make it the one that renders.

    Depth of field stays off: it would blur depth together with the colours.
    """
    data = bpy.data.cameras.new("Camera")
    data.type = "PERSP"
    data.clip_start = settings.clip_start
    data.clip_end = settings.clip_end
    camera = bpy.data.objects.new("Camera", data)
    scene.collection.objects.link(camera)
    scene.camera = camera
    set_intrinsics(scene, settings.pinhole((scene.render.resolution_x, scene.render.resolution_y)))
    return camera


def add_right_camera(scene: bpy.types.Scene, baseline: float) -> bpy.types.Object:
    """Hang a camera of the same lens on the scene's camera, ``baseline`` metres to its right, and return it."""
    right = bpy.data.objects.new("Right camera", scene.camera.data)
    right.parent = scene.camera
    right.location = (baseline, 0, 0)
    scene.collection.objects.link(right)
    return right


def set_intrinsics(scene: bpy.types.Scene, camera: PinholeCamera) -> None:
    """Give the scene's camera and render settings the intrinsics ``camera``, and first samples in pixel centres.

    Blender has no fx, fy, cx, cy. With the horizontal fit, lens over sensor is fx over the width, both shifts are in
    widths of the image, and fy differs from fx by the shape of a pixel.
    """
    render, data = scene.render, scene.camera.data
    render.resolution_x, render.resolution_y = camera.width, camera.height
    # Blender takes aspects from 1 to 200 for each side.
    render.pixel_aspect_x = max(1.0, camera.fy / camera.fx)
    render.pixel_aspect_y = max(1.0, camera.fx / camera.fy)
    lens_over_sensor = camera.fx / camera.width
    data.sensor_fit = "HORIZONTAL"
    data.lens_unit = "MILLIMETERS"
    data.lens = float(np.clip(_SENSOR_MM * lens_over_sensor, *_LENS_RANGE_MM))
    data.sensor_width = data.lens / lens_over_sensor
    data.shift_x = ((camera.width - 1) / 2 - camera.cx) / camera.width
    data.shift_y = (camera.cy - (camera.height - 1) / 2) / camera.width * (camera.fx / camera.fy)
    data.pop(_SHIFTED_PX, None)
    centre_first_samples(scene)


def centre_first_samples(scene: bpy.types.Scene) -> None:
    """Shift the scene's camera so that the first sample of each pixel goes through its centre; once a camera."""
    data = scene.camera.data
    if _SHIFTED_PX in data:
        return
    x, y = _fitted_side_px(scene)
    data.shift_x -= FIRST_SAMPLE_PX / x
    data.shift_y -= FIRST_SAMPLE_PX / y
    data[_SHIFTED_PX] = FIRST_SAMPLE_PX


def _fitted_side_px(scene: bpy.types.Scene) -> tuple[float, float]:
    """Return the side that shifts are measured in, in widths and in heights of a pixel."""
    render, fit = scene.render, scene.camera.data.sensor_fit
    width, height = render.resolution_x, render.resolution_y
    aspect = render.pixel_aspect_x / render.pixel_aspect_y
    across = fit == "HORIZONTAL" or (fit == "AUTO" and width * aspect >= height)
    side_px = width if across else height / aspect
    return side_px, side_px * aspect


def read_intrinsics(scene: bpy.types.Scene) -> PinholeCamera:
    """Return the intrinsics of the scene's camera at its render size, from Blender's own projection matrix.

    The matrix maps Blender's camera axes to [-1, 1] across the image (OpenGL's clip space); single precision, so
    that the numbers hold to 1e-7. The shift that centres first samples is taken off.
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
    shifted_px = scene.camera.data.get(_SHIFTED_PX, 0.0)
    return PinholeCamera.from_corner_origin(
        width=width,
        height=height,
        fx=clip_from_camera[0, 0] * width / 2,
        fy=clip_from_camera[1, 1] * height / 2,
        cx=(1 - clip_from_camera[0, 2]) * width / 2 - shifted_px,
        cy=(1 + clip_from_camera[1, 2]) * height / 2 + shifted_px,
    )


def read_pose(scene: bpy.types.Scene, camera: bpy.types.Object | None = None) -> Matrix:
    """Return world_from_camera, OpenCV axes, of a camera (the scene's) as Blender evaluates it at the current frame."""
    evaluated = (camera or scene.camera).evaluated_get(bpy.context.evaluated_depsgraph_get())
    world_from_blender = np.array(evaluated.matrix_world, dtype=np.float64)
    return rigid(world_from_blender @ BLENDER_FROM_OPENCV, source=f"Blender's camera at frame {scene.frame_current}")
