import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from hypothesis import given, settings
from hypothesis import strategies as st
from mathutils import Vector

from blender_addon.files.reconstruction_files import Intrinsics
from blender_addon.results.camera_conversion import blender_pose, set_intrinsics, set_render_size
from datagen.camera import PinholeCamera
from datagen.rigid import inverse, look_at, transform_points

WORLD_FROM_CAMERA = look_at((1.4, -2.1, 0.9), (0.1, 0.2, -0.3), up=(0.2, 0.1, 1))
CAMERAS = [
    PinholeCamera(width=640, height=480, fx=585.0, fy=585.0, cx=320.0, cy=240.0),
    PinholeCamera(width=640, height=480, fx=520.3, fy=611.7, cx=301.2, cy=262.9),
    PinholeCamera(width=320, height=640, fx=411.0, fy=300.0, cx=170.5, cy=288.1),
    PinholeCamera(width=640, height=360, fx=12.0, fy=13.0, cx=319.5, cy=179.5),
]


@pytest.mark.usefixtures("empty_scene")
@pytest.mark.parametrize("camera", CAMERAS)
def test_blender_projects_as_the_pinhole_does(camera: PinholeCamera) -> None:
    points_world = _points_in_view(camera)
    expected_px = camera.project(transform_points(inverse(WORLD_FROM_CAMERA), points_world))
    found_px = _project_by_matrix(camera, points_world)
    assert np.abs(found_px - expected_px).max() < 0.01
    # Blender's second, independent way to the picture: fractions of the view, from the lower left corner.
    item, _ = _blender_camera(camera)
    views = np.array([world_to_camera_view(bpy.context.scene, item, Vector(point))[:2] for point in points_world])
    views_px = np.column_stack([views[:, 0] * camera.width, (1 - views[:, 1]) * camera.height]) - 0.5
    assert np.abs(views_px - expected_px).max() < 0.01


@pytest.mark.usefixtures("empty_scene")
def test_the_half_pixel_is_put_back_once() -> None:
    """A point on the axis of a camera with a centred principal point falls on the render's exact centre."""
    camera = PinholeCamera(width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5)
    item, _ = _blender_camera(camera)
    assert item.data.shift_x == 0
    assert item.data.shift_y == 0
    shifted = PinholeCamera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    item, _ = _blender_camera(shifted)
    assert item.data.shift_x == pytest.approx(-0.5 / 640)
    assert item.data.shift_y == pytest.approx(0.5 / 640)


@pytest.mark.usefixtures("empty_scene")
@settings(deadline=None, max_examples=30)
@given(
    width=st.integers(16, 4000),
    height=st.integers(16, 4000),
    focal=st.floats(0.3, 5.0),
    aspect=st.floats(0.3, 3.0),
    shift=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
)
def test_any_intrinsics_survive(
    width: int, height: int, focal: float, aspect: float, shift: tuple[float, float]
) -> None:
    camera = PinholeCamera(
        width=width,
        height=height,
        fx=focal * width,
        fy=focal * width * aspect,
        cx=width * (0.5 + shift[0]),
        cy=height * (0.5 + shift[1]),
    )
    points_world = _points_in_view(camera)
    points_camera = transform_points(inverse(WORLD_FROM_CAMERA), points_world)
    expected_px = camera.project(points_camera)
    # Blender keeps single precision, a few millionths of a picture's side. Far from the axis depth is the small
    # difference of large numbers, rounded as these are.
    slant = float((np.linalg.norm(points_camera, axis=1) / points_camera[:, 2]).max())
    tolerance_px = max(0.01, max(5e-6, 4 * np.finfo(np.float32).eps * slant) * max(width, height))
    assert np.abs(_project_by_matrix(camera, points_world) - expected_px).max() < tolerance_px


def _points_in_view(camera: PinholeCamera) -> np.ndarray:
    corners = np.array([(0, 0), (1, 0), (0, 1), (1, 1), (0.5, 0.5), (0.2, 0.7)]) * (camera.width - 1, camera.height - 1)
    depth = np.array([0.5, 1.0, 2.0, 3.0, 1.5, 0.7])[:, None]
    rays = (corners - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return transform_points(WORLD_FROM_CAMERA, np.hstack([rays, np.ones((6, 1))]) * depth)


def _blender_camera(camera: PinholeCamera) -> tuple[bpy.types.Object, bpy.types.RenderSettings]:
    scene = bpy.context.scene
    item = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(item)
    set_intrinsics(item.data, Intrinsics(**vars(camera)))
    set_render_size(scene.render, Intrinsics(**vars(camera)))
    item.matrix_world = blender_pose(WORLD_FROM_CAMERA)
    bpy.context.view_layer.update()
    return item, scene.render


def _project_by_matrix(camera: PinholeCamera, points_world: np.ndarray) -> np.ndarray:
    """Return pixel coordinates (integer centres) by the matrix with which Blender renders."""
    item, render = _blender_camera(camera)
    clip_from_camera = item.calc_matrix_camera(
        bpy.context.evaluated_depsgraph_get(),
        x=render.resolution_x,
        y=render.resolution_y,
        scale_x=render.pixel_aspect_x,
        scale_y=render.pixel_aspect_y,
    )
    clip_from_world = np.array(clip_from_camera) @ np.linalg.inv(np.array(item.matrix_world))
    clip = np.column_stack([points_world, np.ones(len(points_world))]) @ clip_from_world.T
    x, y = (clip[:, :2] / clip[:, 3:]).T
    return np.column_stack([(x + 1) / 2 * camera.width, (1 - y) / 2 * camera.height]) - 0.5
