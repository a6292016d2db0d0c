import numpy as np
import pytest

from blender_addon.headless.overview_camera import FieldOfView, overview_direction, overview_pose, without_strays
from datagen.rigid import inverse, look_at, transform_points

FIELD_OF_VIEW = FieldOfView(0.36, 0.2)
ORBIT = [look_at((2 * np.cos(a), 2 * np.sin(a), 0.7), (0, 0, 0)) for a in np.linspace(0, 6, 20)]
ROOM_Y_DOWN = [look_at((x, 0, 0), (x, 0.2, 3), up=(0, -1, 0)) for x in np.linspace(-0.5, 0.5, 5)]
UPWARDS = [look_at((0, 0, -1), (0, 0, 1), up=(0, 1, 0))]


@pytest.mark.parametrize("cameras", [ORBIT, ROOM_Y_DOWN, UPWARDS, []])
def test_all_is_in_view_and_fills_it(cameras: list[np.ndarray]) -> None:
    points_world = np.random.default_rng(3).normal(size=(500, 3)) * (1, 3, 0.5) + (4, 5, 6)
    pose = overview_pose(points_world, cameras, field_of_view=FIELD_OF_VIEW)
    x, y, z = transform_points(inverse(pose), points_world).T
    assert z.min() > 0
    across, along = np.abs(x / z) / FIELD_OF_VIEW.tan_half_x, np.abs(y / z) / FIELD_OF_VIEW.tan_half_y
    assert max(across.max(), along.max()) == pytest.approx(0.92)


def test_a_scan_with_z_up_is_seen_with_z_up_from_above_its_front() -> None:
    pose = overview_pose(np.eye(3), ORBIT, field_of_view=FIELD_OF_VIEW)
    assert pose[2, 0] == pytest.approx(0)  # the horizon is level
    assert pose[2, 1] < -0.8
    assert overview_direction(ORBIT)[1] > 0.5


def test_a_scan_of_a_room_is_seen_as_its_cameras_saw_it() -> None:
    """Also where Z is not up, as in recordings whose world is their first camera."""
    pose = overview_pose(np.eye(3), ROOM_Y_DOWN, field_of_view=FIELD_OF_VIEW)
    assert pose[1, 1] > 0.8
    assert pose[2, 2] > 0.8


def test_specks_far_from_all_else_do_not_count() -> None:
    cloud = np.random.default_rng(0).uniform(-1, 1, (1000, 3))
    kept = without_strays(np.vstack([cloud, [(50, 0, 0), (0, -50, 0)]]))
    assert np.abs(kept).max() <= 1
    assert len(kept) > 900
