from dataclasses import asdict

import numpy as np
import pytest
from three_balls import CAMERA, OFFSET, POSES, ball_model, see

from fusion.pose.evidence import Evidence, gather_evidence
from fusion.pose.query import Query
from fusion.pose.se3 import perturb


@pytest.fixture
def balls(device):
    return ball_model(device)


def evidence(model, depth, mask=None, pose=POSES[0], camera=CAMERA):
    return gather_evidence(model, Query(camera=camera, depth=depth, mask=mask), pose)


def test_at_the_true_pose_everything_speaks_for_it(balls):
    for pose in POSES:
        depth = see(pose)
        for mask in (None, depth > 0):
            told = evidence(balls, depth, mask, pose)
            assert min(told.agreeing, told.filled, told.slopes, 1 - told.free) > 0.99
            assert told.residual_m < 0.2 * balls.voxel_size
            assert (told.covered is None) == (mask is None)
            assert told.depth_pixels == (depth > 0).sum()


def test_what_stands_before_the_model_says_nothing(balls):
    depth = see(POSES[0])
    mask = depth > 0
    hidden = np.zeros_like(mask)
    hidden[:, :80] = True
    told = evidence(balls, np.where(hidden, 0.3, depth).astype(np.float32), mask & ~hidden)
    assert min(told.covered, told.filled, told.agreeing) > 0.98
    assert told.free == 0


def test_looking_through_the_model_speaks_against_it(balls):
    depth = see(POSES[0])
    wall = np.where(depth > 0, depth, 2.0).astype(np.float32)
    # One of the balls is gone: the wall behind it is seen.
    without = np.where(see(POSES[0]) == see(POSES[0], centres=OFFSET + np.zeros((1, 3)), radii=[0.1]), wall, 2.0)
    gone = (depth > 0) & (without == 2.0)
    told = evidence(balls, without.astype(np.float32), (depth > 0) & ~gone)
    assert told.free == pytest.approx(gone.sum() / (depth > 0).sum(), abs=0.1)
    assert told.filled == pytest.approx(1 - gone.sum() / (depth > 0).sum(), abs=0.1)
    assert told.agreeing > 0.98


def test_a_mask_the_model_does_not_fill_and_one_it_does_not_cover(balls):
    depth = see(POSES[0])
    half = (depth > 0) & (np.arange(CAMERA.width) < 80)
    share = half.sum() / (depth > 0).sum()
    told = gather_evidence(balls, Query(camera=CAMERA, mask=half), POSES[0])
    assert told.filled == pytest.approx(share, abs=0.02)
    assert told.covered > 0.98
    wide = np.zeros_like(half)
    wide[20:100, 30:130] = True
    told = gather_evidence(balls, Query(camera=CAMERA, mask=wide), POSES[0])
    assert told.covered == pytest.approx((wide & (depth > 0)).sum() / wide.sum(), abs=0.02)
    assert told.agreeing is None


def test_another_slope_at_the_same_depth_is_seen(balls):
    depth = see(POSES[0])
    # Within the tolerance, but pleated as no ball is.
    rows, _columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    pleated = np.where(depth > 0, depth + 0.0062 * np.sin(rows * 2 * np.pi / 9), 0).astype(np.float32)
    assert evidence(balls, pleated, depth > 0).slopes < 0.7
    assert evidence(balls, depth, depth > 0).slopes == 1


def test_a_wrong_pose_agrees_less(balls):
    depth = see(POSES[0])
    off = perturb(np.array([0.05, 0, 0, 0, 0, 0]), POSES[0], pivot_world=OFFSET)
    told = evidence(balls, depth, depth > 0, off)
    assert told.agreeing < 0.8
    assert told.covered < 0.9


def test_where_nothing_is_there_is_no_evidence(balls):
    empty = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    assert evidence(balls, empty) == Evidence()
    assert evidence(balls, see(POSES[0]), empty > 0) == Evidence()
    assert all(value in (None, 0) for value in asdict(Evidence()).values())
