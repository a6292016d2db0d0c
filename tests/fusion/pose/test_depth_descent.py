"""Descents that stay on the device, against NumPy's steps on the host."""

import numpy as np
import pytest
import warp as wp
from three_balls import CAMERA, OFFSET, POSES, VOXEL, ball_model, see, twist

from fusion.pose.cholesky import Sums64
from fusion.pose.depth_descent import DepthDescent, damped_step, exponential_of, left_jacobian
from fusion.pose.levenberg_marquardt import descend
from fusion.pose.normal_equations import GEMAN_MCCLURE, INLIER_SIGMAS, SUMS, TUKEY, Robustness, normal_equations
from fusion.pose.query import Query, query_cloud
from fusion.pose.se3 import exp_se3, perturb

FLOOR, RADIUS, COUNT = 0.12 * VOXEL, 0.05, 777


@pytest.fixture
def model(device):
    return ball_model(device)


@wp.kernel
def _exponentials(twists: wp.array(dtype=wp.spatial_vectord), found: wp.array(dtype=wp.mat44d)):
    index = wp.tid()
    turn = wp.spatial_bottom(twists[index])
    rotation = exponential_of(turn)
    shift = left_jacobian(turn) * wp.spatial_top(twists[index])
    result = wp.identity(n=4, dtype=wp.float64)
    for row in range(3):
        for column in range(3):
            result[row, column] = rotation[row, column]
        result[row, 3] = shift[row]
    found[index] = result


def test_the_exponential_in_the_kernel_is_that_of_se3(device):
    rng = np.random.default_rng(0)
    sizes = np.array([0, 1e-9, 1e-3, 0.99e-2, 1.01e-2, 0.3, 2.0, 3.1])
    twists = rng.normal(size=(len(sizes), 6))
    twists[:, 3:] *= (sizes / np.linalg.norm(twists[:, 3:], axis=1))[:, None]
    found = wp.empty(len(sizes), dtype=wp.mat44d, device=device)
    wp.launch(_exponentials, len(sizes), [wp.array(twists, dtype=wp.spatial_vectord, device=device)], [found])
    np.testing.assert_allclose(found.numpy(), exp_se3(twists), atol=1e-12)


@wp.kernel
def _steps(sums: wp.array(dtype=Sums64), radius: wp.float64, found: wp.array(dtype=wp.spatial_vectord)):
    found[wp.tid()] = damped_step(sums[wp.tid()], wp.float64(1e-9), radius)


def test_a_step_solves_the_equations_and_is_no_longer_than_the_linearisation_holds(device):
    rng = np.random.default_rng(1)
    rows, columns = np.triu_indices(6)
    factors = rng.normal(size=(6, 40, 6)) * [1, 1, 1, RADIUS, RADIUS, RADIUS]
    hessian = np.swapaxes(factors, 1, 2) @ factors
    gradient = rng.normal(size=(6, 6)) * [1, 1, 1, RADIUS, RADIUS, RADIUS] * np.geomspace(1e-2, 1e4, 6)[:, None]
    sums = np.zeros((6, SUMS))
    sums[:, :21], sums[:, 21:27] = hessian[:, rows, columns], gradient
    found = wp.empty(6, dtype=wp.spatial_vectord, device=device)
    wp.launch(_steps, 6, [wp.array(sums, dtype=Sums64, device=device), wp.float64(RADIUS)], [found], device=device)
    expected = np.linalg.solve(hessian, -gradient[..., None])[..., 0]
    longest = np.maximum(np.linalg.norm(expected[:, 3:], axis=1), np.linalg.norm(expected[:, :3], axis=1) / 2 / RADIUS)
    assert longest[0] < 0.35 < longest[-1]
    expected /= np.maximum(longest / 0.35, 1)[:, None]
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-6)


@pytest.mark.parametrize("kind", [GEMAN_MCCLURE, TUKEY])
def test_a_descent_on_the_device_is_that_on_the_host(model, kind):
    cloud = query_cloud(Query(camera=CAMERA, depth=see(POSES[0])), device=model.device)
    starts = np.stack(
        [perturb(twist(np.random.default_rng(i), 3, 0.01), POSES[0], pivot_world=OFFSET) for i in range(3)]
    )
    scales = np.array([0.02, 0.01, 0.03])
    lengths = {"pivot_world": OFFSET, "radius_m": RADIUS, "enough_m": 0.05 * FLOOR, "sure_m": FLOOR}
    descents = DepthDescent(model, cloud, poses=1, count=COUNT, floor=FLOOR, **lengths)
    together = DepthDescent(model, cloud, poses=3, count=COUNT, floor=FLOOR, **lengths)
    all_found = together.descend(starts, kind=kind, scales=scales, iterations=9)
    for i, start in enumerate(starts):
        robustness = Robustness(kind=kind, scales=scales[i : i + 1], floor=FLOOR, inlier_within=INLIER_SIGMAS * FLOOR)

        def equations(at, robustness=robustness):
            return normal_equations(model, cloud, at, count=COUNT, pivot_world=OFFSET, robustness=robustness)

        expected = descend(equations, start[None], iterations=9, **lengths)
        found = descents.descend(start[None], kind=kind, scales=scales[i : i + 1], iterations=9)
        # The same steps, but for what rounding does to the points.
        np.testing.assert_allclose(found.poses, expected.poses, atol=1e-6)
        np.testing.assert_allclose(found.normals.cost, expected.normals.cost, rtol=1e-3)
        assert found.iterations == expected.iterations
        # Other poses beside it change nothing.
        np.testing.assert_array_equal(all_found.poses[i], found.poses[0])
