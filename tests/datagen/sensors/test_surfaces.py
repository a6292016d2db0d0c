import numpy as np
import pytest
from analytic_depth import CAMERA, rays, step, tilted_plane

from datagen.sensors.surfaces import (
    continuous_along_u,
    cos_incidence,
    cos_incidence_of_normals,
    depth_edges,
    inverse_depth,
    inverse_depth_slopes,
)


def angle_from_depth(depth, camera):
    w = inverse_depth(depth)
    return np.arccos(cos_incidence(w, inverse_depth_slopes(w), camera))


@pytest.mark.parametrize("tilt_deg", [0, 20, 45, 65])
@pytest.mark.parametrize("axis", [(0.0, 1.0), (1.0, 0.0), (0.6, 0.8)])
def test_the_angle_at_which_a_plane_is_seen_is_exact_up_to_the_image_border(tilt_deg, axis):
    depth, theta = tilted_plane(CAMERA, distance=1.5, tilt_deg=tilt_deg, axis=axis)
    valid = depth > 0
    np.testing.assert_allclose(np.cos(angle_from_depth(depth, CAMERA))[valid], np.cos(theta)[valid], atol=2e-4)


def test_the_angle_beside_an_edge_is_that_of_the_own_surface():
    left, theta = tilted_plane(CAMERA, distance=1.0, tilt_deg=50)
    right, theta_right = tilted_plane(CAMERA, distance=2.0, tilt_deg=-30)
    depth = np.where(np.arange(CAMERA.width) < 160, left, right)
    expected = np.where(np.arange(CAMERA.width) < 160, theta, theta_right)
    np.testing.assert_allclose(np.cos(angle_from_depth(depth, CAMERA)), np.cos(expected), atol=2e-4)


def test_a_thin_pole_has_no_slope_across():
    depth = np.full((20, 30), 2.0, np.float32)
    depth[:, 14] = 1.0
    across, _ = inverse_depth_slopes(inverse_depth(depth))
    assert (across == 0).all()


def test_normals_and_depth_tell_the_same_angle():
    depth, theta = tilted_plane(CAMERA, distance=1.5, tilt_deg=40)
    normal = np.array([np.sin(np.radians(40)), 0, np.cos(np.radians(40))])
    normals = np.broadcast_to(-normal, (*depth.shape, 3))
    np.testing.assert_allclose(np.arccos(cos_incidence_of_normals(normals, CAMERA)), theta, atol=1e-3)
    assert rays(CAMERA).shape == normals.shape


def test_edges_are_the_two_pixels_at_a_step_and_none_on_a_steep_plane():
    edges = depth_edges(inverse_depth(step(CAMERA, near=1.0, far=1.1, column=100)))
    np.testing.assert_array_equal(np.flatnonzero(edges.all(axis=0)), [99, 100])
    assert edges.sum() == 2 * CAMERA.height
    steep, _ = tilted_plane(CAMERA, distance=1.5, tilt_deg=60)
    assert not depth_edges(inverse_depth(steep))[steep > 0].any()


def test_pixels_without_depth_continue_nothing():
    w = inverse_depth(step(CAMERA, near=0.0, far=1.0, column=100))
    joined = continuous_along_u(w, tolerance=0.01)
    assert not joined[:, :100].any()
    assert joined[:, 100:].all()
