"""Views of three balls, whose poses are known, aligned with each other."""

import numpy as np
import pytest
import trimesh
import warp as wp
from scipy.spatial.transform import Rotation
from three_balls import CAMERA, CENTRES, OFFSET, RADII, see, twist

from datagen.rigid import look_at
from fusion.pose.cholesky import Sums64, solve_symmetric
from fusion.pose.normal_equations import SUMS
from fusion.pose.pose_distance import pose_distances
from fusion.pose.se3 import exp_se3, perturb
from fusion.pose.small_query import small_query
from fusion.pose.view_index import PATCH_SIDE, index_views, patch_differences, turn_between
from fusion.pose.view_registration import register
from fusion.surface.mesh import Mesh

POSE = look_at(OFFSET + np.array([0.35, -0.56, 0.21]), OFFSET)


@pytest.fixture
def index(device):
    """The balls seen from one pose, and that pose turned on the spot by 5°."""
    balls = [trimesh.creation.icosphere(5, radius) for radius in RADII]
    for ball, centre in zip(balls, CENTRES, strict=True):
        ball.apply_translation(centre)
    shape = trimesh.util.concatenate(balls)
    mesh = Mesh(vertices=np.asarray(shape.vertices, np.float32), triangles=np.asarray(shape.faces, np.int32))
    return index_views(mesh, [POSE, POSE @ exp_se3(np.radians([0, 0, 0, 3, 4, 0]))], CAMERA, device=device)


@wp.kernel
def _solve(sums: wp.array(dtype=Sums64), damping: wp.float64, solutions: wp.array(dtype=wp.spatial_vectord)):
    solutions[wp.tid()] = solve_symmetric(sums[wp.tid()], damping)


def test_the_solution_in_the_kernel_is_numpys(device):
    rng = np.random.default_rng(0)
    rows, columns = np.triu_indices(6)
    factors, right = rng.normal(size=(20, 9, 6)), rng.normal(size=(20, 6))
    left = np.swapaxes(factors, 1, 2) @ factors
    sums = np.zeros((20, SUMS))
    sums[:, :21], sums[:, 21:27] = left[:, rows, columns], right
    solutions = wp.empty(20, dtype=wp.spatial_vectord, device=device)
    wp.launch(_solve, 20, [wp.array(sums, dtype=Sums64, device=device), wp.float64(0.01)], [solutions], device=device)
    expected = np.linalg.solve(left + 0.01 * np.eye(6), -right[..., None])[..., 0]
    np.testing.assert_allclose(solutions.numpy(), expected, rtol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_a_view_turned_and_shifted_is_aligned(index, seed):
    truth = perturb(twist(np.random.default_rng(seed), 6.0, 0.03), POSE, pivot_world=OFFSET)
    query = small_query(index, see(truth), None)
    start = np.eye(4)[None]
    aligned = register(index, np.array([0]), query, start, points=1500, iterations=16)
    found = POSE @ aligned.view_from_query[0]
    # Nearest is also what is within a tenth of the nearest view's distance: so well the query's pose has to be known.
    before, after = pose_distances(np.stack([POSE, found]), truth, depth=query.typical_depth)
    assert after < 0.1 * before
    assert aligned.costs[0] < 0.2


def test_what_explains_a_query_costs_nothing_and_what_does_not_all(index):
    query = small_query(index, see(POSE), None)
    elsewhere = np.eye(4)
    elsewhere[:3, 3] = 0, 0, 5
    starts = np.stack([np.eye(4), elsewhere])
    aligned = register(index, np.array([0, 0]), query, starts, points=1500, iterations=0)
    assert aligned.costs[0] < 0.02
    assert aligned.costs[1] == pytest.approx(1)


def test_a_patch_does_not_depend_on_the_place_in_the_image(index):
    # Both views have one eye: as many cells as the outline crosses may change, by the cap of 0.3.
    difference = patch_differences(index, index.patches[:1])
    assert difference[0] == 0
    assert difference[1] < 0.3**2 * 4 * PATCH_SIDE


def test_turns_take_one_direction_to_the_other_by_the_smallest_angle():
    rng = np.random.default_rng(1)
    starts, ends = rng.normal(size=(2, 50, 3))
    starts = np.concatenate([starts, np.eye(3), np.eye(3)])
    ends = np.concatenate([ends, -2 * np.eye(3), np.eye(3)])
    turns = turn_between(starts, ends)
    units = ends / np.linalg.norm(ends, axis=1, keepdims=True)
    turned = (turns @ (starts / np.linalg.norm(starts, axis=1, keepdims=True))[..., None])[..., 0]
    np.testing.assert_allclose(turned, units, atol=1e-12)
    np.testing.assert_allclose(turns @ np.swapaxes(turns, 1, 2), np.tile(np.eye(3), (56, 1, 1)), atol=1e-12)
    cosines = (starts * units).sum(axis=1) / np.linalg.norm(starts, axis=1)
    np.testing.assert_allclose(Rotation.from_matrix(turns).magnitude(), np.arccos(cosines), atol=1e-7)
