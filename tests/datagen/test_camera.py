import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.camera import PinholeCamera
from datagen.errors import InputError

CAMERA = PinholeCamera(width=8, height=6, fx=10.0, fy=12.0, cx=3.25, cy=2.75)


@given(st.floats(-0.5, 7.5), st.floats(-0.5, 5.5), st.floats(0.01, 100))
def test_projecting_undoes_back_projecting(u, v, z):
    point = np.array([(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z])
    np.testing.assert_allclose(CAMERA.project(point), [u, v], atol=1e-9)


def test_back_projected_pixels_project_onto_their_integer_coordinates():
    depth = np.random.default_rng(0).uniform(0.5, 3, (6, 8))
    pixels = CAMERA.project(CAMERA.back_project(depth))
    u, v = np.meshgrid(np.arange(8), np.arange(6))
    np.testing.assert_allclose(pixels, np.stack([u, v], axis=-1), atol=1e-12)


def test_back_projected_z_is_the_depth_and_not_a_distance():
    depth = np.full((6, 8), 2.0)
    np.testing.assert_array_equal(CAMERA.back_project(depth)[..., 2], depth)


def test_the_principal_point_of_a_centred_camera_lies_between_the_middle_pixels():
    camera = PinholeCamera.from_corner_origin(width=640, height=480, fx=500, fy=500, cx=320, cy=240)
    assert (camera.cx, camera.cy) == (319.5, 239.5)


@pytest.mark.parametrize("wrong", [{"width": 0}, {"height": -1}, {"fx": 0.0}, {"fy": -5.0}, {"cx": np.nan}])
def test_impossible_intrinsics_are_refused(wrong):
    right = {"width": 8, "height": 6, "fx": 10.0, "fy": 10.0, "cx": 3.5, "cy": 2.5}
    with pytest.raises(InputError, match="camera: "):
        PinholeCamera(**(right | wrong))
