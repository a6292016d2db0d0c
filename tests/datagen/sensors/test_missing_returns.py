import numpy as np
import pytest
from analytic_depth import CAMERA, tilted_plane

from datagen.sensors.missing_returns import grazing_loss, unseen_by_second_view
from datagen.sensors.surfaces import inverse_depth

DISPARITY_PX_M = 30.0


def unseen_columns(depth, *, needs_image=False):
    unseen = unseen_by_second_view(inverse_depth(depth), disparity_px_m=DISPARITY_PX_M, needs_image=needs_image)
    assert (unseen == unseen[0]).all()
    return np.flatnonzero(unseen[0])


@pytest.fixture
def wall():
    return np.full((6, 300), 3.0, np.float32)


def test_an_object_throws_its_shadow_to_its_left_as_wide_as_disparities_differ(wall):
    wall[:, 150:250] = 1.0
    width = round(DISPARITY_PX_M * (1 / 1.0 - 1 / 3.0))
    np.testing.assert_array_equal(unseen_columns(wall), np.arange(150 - width, 150))


def test_a_pole_throws_a_shadow_as_wide_as_itself_apart_from_it(wall):
    wall[:, 150:155] = 1.0
    shift = round(DISPARITY_PX_M * (1 / 1.0 - 1 / 3.0))
    hidden = unseen_columns(wall)
    assert set(range(150 - shift, 155 - shift)) <= set(hidden)
    assert set(hidden) <= set(range(150 - shift - 1, 155 - shift + 1))


def test_only_a_second_camera_misses_what_leaves_its_image(wall):
    assert unseen_columns(wall).size == 0
    np.testing.assert_array_equal(unseen_columns(wall, needs_image=True), np.arange(round(DISPARITY_PX_M / 3.0)))


@pytest.mark.parametrize("tilt_deg", [-75, -40, 0, 40, 75])
def test_a_plane_does_not_hide_itself(tilt_deg):
    depth, _ = tilted_plane(CAMERA, distance=2.0, tilt_deg=tilt_deg)
    depth[depth > 20] = 0
    assert not unseen_by_second_view(inverse_depth(depth), disparity_px_m=CAMERA.fx * 0.075, needs_image=False).any()


def test_nothing_hides_where_the_object_is_seen_first(wall):
    wall[:, 200:] = 0
    assert unseen_columns(wall).size == 0


def test_returns_are_lost_gradually_with_the_angle():
    loss = grazing_loss(np.radians([0, 70, 77.5, 85, 89]).astype(np.float32), (70.0, 85.0))
    np.testing.assert_allclose(loss, [0, 0, 0.5, 1, 1], atol=1e-5)
