import numpy as np
import pytest
from scipy.optimize import least_squares

from datagen.rigid import inverse, look_at
from fusion.pose.combination import combined
from fusion.pose.refinement import Refinement, declined
from fusion.pose.se3 import about_pivot, exp_se3, log_se3
from fusion.pose.uncertainty import uncertainty

POSE = look_at((0.9, 0.4, 0.3), (0.1, 0, 0))


def refinement(stage, rng, *, information=1.0, free=()):
    """A pose near POSE that is known about a pivot of its own, in the directions that are not ``free`` alone."""
    pivot, radius = 0.3 * rng.normal(size=3), rng.uniform(0.1, 0.5)
    rows = rng.normal(size=(12, 6)) * [1e3, 1e3, 1e3, 300, 300, 300] * information
    for direction in free:
        rows -= np.outer(rows @ direction, direction)
    pose = about_pivot(exp_se3(0.002 * rng.normal(size=6)), -pivot) @ POSE
    known = uncertainty(rows.T @ rows, sigma=1.0, pivot_world=pivot, radius_m=radius)
    return Refinement(stage=stage, world_from_camera=pose, converged=True, uncertainty=known)


def misfit(pose, found):
    known = found.uncertainty
    twist = log_se3(about_pivot(pose @ inverse(found.world_from_camera), known.pivot_world))
    return np.linalg.solve(np.linalg.cholesky(known.covariance), twist)


@pytest.mark.parametrize("seed", range(4))
def test_combined_poses_are_the_least_squares_of_both_whatever_their_pivots(seed):
    rng = np.random.default_rng(seed)
    first, second = refinement("epipolar", rng), refinement("silhouette", rng)
    best = least_squares(
        lambda twist: np.concatenate([misfit(exp_se3(twist) @ POSE, one) for one in (first, second)]),
        np.zeros(6),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    found = combined(first, second)
    off = log_se3(found.world_from_camera @ inverse(exp_se3(best.x) @ POSE))
    # Twists of 0.005 add up to their square, which weighing them leaves out.
    assert np.abs(off).max() < 1e-4
    # What is found about one pivot holds about any other: misfits there are as likely as here.
    spread = np.linalg.inv(best.jac.T @ best.jac)
    pivot = found.uncertainty.pivot_world
    moved = np.eye(6)
    moved[:3, 3:] = -np.array([[0, -pivot[2], pivot[1]], [pivot[2], 0, -pivot[0]], [-pivot[1], pivot[0], 0]])
    np.testing.assert_allclose(found.uncertainty.covariance, moved @ spread @ moved.T, rtol=0.05, atol=1e-8)


def test_a_direction_that_one_of_them_does_not_know_is_the_others():
    rng = np.random.default_rng(7)
    first, second = refinement("epipolar", rng), refinement("silhouette", rng, information=1e3, free=[np.eye(6)[4]])
    found = combined(first, second)
    between = log_se3(
        about_pivot(found.world_from_camera @ inverse(second.world_from_camera), second.uncertainty.pivot_world)
    )
    # Only along the free direction does it leave the second, which is a thousand times as sure of the others; turns do
    # not commute, by the square of their angle.
    assert abs(between[4]) > 1e-3
    assert np.abs(np.delete(between, 4)).max() < between[4] ** 2


def test_a_stage_that_declined_has_no_part_in_it():
    rng = np.random.default_rng(3)
    first, second = refinement("epipolar", rng), refinement("silhouette", rng)
    none = declined("epipolar", POSE, "too little texture", unit="px")
    assert combined(none, second) is second
    gone = declined("silhouette", first.world_from_camera, "no mask", unit="px")
    assert combined(first, gone) is gone
