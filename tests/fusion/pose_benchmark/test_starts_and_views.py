import cv2
import numpy as np
import pytest
from three_balls import CAMERA, OFFSET, POSES, see

from datagen.rigid import inverse, rotation_angle_deg, transform_points
from fusion.pose_benchmark.perturbations import Perturbation, perturbed, random_direction
from fusion.pose_benchmark.views import Noise, View, spoiled


def view(pose=POSES[0]):
    depth = see(pose)
    color = np.where(depth[..., None] > 0, np.uint8(200), np.uint8(0)).repeat(3, axis=-1)
    return View(camera=CAMERA, color=color, depth=depth, mask=None, world_from_camera=pose)


def test_a_perturbation_turns_by_its_angle_and_shifts_the_pivot_by_its_length():
    rng = np.random.default_rng(0)
    for degrees, metres in ((10.0, 0.04), (40.0, 0.16), (0.0, 0.1), (25.0, 0.0)):
        for truth in POSES:
            found = perturbed(truth, Perturbation(degrees=degrees, metres=metres), pivot_world=OFFSET, rng=rng)
            assert rotation_angle_deg(inverse(found) @ truth) == pytest.approx(degrees, abs=1e-6)
            middle = transform_points(inverse(truth), OFFSET)
            assert np.linalg.norm(transform_points(found, middle) - OFFSET) == pytest.approx(metres, abs=1e-9)


def test_directions_favour_none():
    rng = np.random.default_rng(1)
    ways = np.array([random_direction(rng) for _ in range(4000)])
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), 1)
    # The mean of n unit vectors is about 1/√n long, their second moments a third.
    assert np.linalg.norm(ways.mean(axis=0)) < 4 / 4000**0.5
    np.testing.assert_allclose(ways.T @ ways / len(ways), np.eye(3) / 3, atol=0.03)


def test_no_more_is_hidden_than_was_asked_and_the_mask_is_off_by_two_pixels_at_most():
    exact = view()
    seen = exact.seen
    shares, grown = [], 0
    for seed in range(40):
        bad = spoiled(exact, Noise(), rng=np.random.default_rng(seed))
        hidden = (bad.color == 96).all(axis=-1)
        shares.append((hidden & seen).sum() / seen.sum())
        left = seen & ~hidden
        square = np.ones((5, 5), np.uint8)
        assert not (bad.mask & ~(cv2.dilate(left.astype(np.uint8), square) > 0)).any()
        assert not ((cv2.erode(left.astype(np.uint8), square) > 0) & ~bad.mask).any()
        assert (bad.mask != left).any()
        grown += bad.mask.sum() > left.sum()
    # A quantile falls on a pixel: a share may be off by one of them.
    assert max(shares) <= 0.3 + 1 / seen.sum()
    assert min(shares) < 0.05
    assert max(shares) > 0.2
    assert 5 < grown < 35


def test_the_occluder_stands_before_the_object_where_the_sensor_sees_it():
    exact = view()
    for seed in range(5):
        bad = spoiled(exact, Noise(occluded=0.3), rng=np.random.default_rng(seed))
        occluder = (bad.color == 96).all(axis=-1) & (bad.depth > 0)
        inner = cv2.erode(occluder.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        if inner.any():
            assert np.median(bad.depth[inner]) == pytest.approx(0.8 * exact.depth[exact.seen].min(), abs=0.01)


def test_the_same_seed_spoils_a_view_alike_and_another_does_not():
    first, again, other = (spoiled(view(), Noise(), rng=np.random.default_rng(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.depth, again.depth)
    np.testing.assert_array_equal(first.mask, again.mask)
    assert (first.depth != other.depth).any()


def test_depth_is_as_noisy_as_the_kinect_is_said_to_be():
    exact = view()
    bad = spoiled(exact, Noise(occluded=0.0), rng=np.random.default_rng(5))
    inner = cv2.erode((exact.depth > 0).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    both = inner & (bad.depth > 0)
    off = bad.depth[both] - exact.depth[both]
    z = np.median(exact.depth[both])
    # Nguyen 2012, where it is not steep.
    assert 1.4826 * np.median(np.abs(off)) == pytest.approx(0.0012 + 0.0019 * (z - 0.4) ** 2, rel=0.25)
