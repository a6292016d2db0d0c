"""A model that is out of place, and a fused frame that tells by how much."""

import numpy as np
import pytest
from three_balls import CAMERA, OFFSET, POSES, ball_model, errors, see, twist

from fusion.pose.depth_refinement import DepthRefinementOptions, refine_with_depth
from fusion.pose.query import Query
from fusion.pose.reference_frame import ReferenceFrame
from fusion.pose.reference_shift import nearest_reference, reference_shift
from fusion.pose.se3 import perturb

COLOR = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)


@pytest.fixture
def model(device):
    return ball_model(device)


def frame(pose, depth):
    return ReferenceFrame(camera=CAMERA, color=COLOR, depth=depth, world_from_camera=pose)


def moved(pose, turn_deg, shift, seed=5):
    return perturb(twist(np.random.default_rng(seed), turn_deg, shift), pose, pivot_world=OFFSET)


def test_where_model_and_poses_disagree_a_frame_nearby_tells_by_how_much(model):
    # The recording has all poses turned and shifted alike from where the model has them.
    drift = (1.5, 0.01)
    here, near = POSES[0], moved(POSES[0], 5.0, 0.02, seed=1)
    query = Query(camera=CAMERA, depth=see(here))
    alone = refine_with_depth(model, query, here)
    told = refine_with_depth(model, query, here, references=[frame(moved(near, *drift), see(near))])
    assert errors(alone.world_from_camera, moved(here, *drift))[1] > 0.009  # it follows the model, as it has to
    angle, distance = errors(told.world_from_camera, moved(here, *drift))
    # As exact as a view of an exact model is: two of those are compared.
    assert angle < 2 * 0.06
    assert distance < 2e-4


def test_where_they_agree_the_pose_stays_as_exact_as_it_was(model):
    near = moved(POSES[1], 5.0, 0.02)
    query = Query(camera=CAMERA, depth=see(POSES[1]))
    told = refine_with_depth(model, query, POSES[1], references=[frame(near, see(near))])
    angle, distance = errors(told.world_from_camera, POSES[1])
    assert angle < 0.06
    assert distance < 1e-4


def test_frames_that_are_far_off_or_empty_tell_nothing(model):
    far, empty = frame(POSES[1], see(POSES[1])), frame(POSES[0], np.zeros_like(see(POSES[0])))
    assert nearest_reference([far, empty], POSES[0]) is None
    query = Query(camera=CAMERA, depth=see(POSES[0]))
    alone = refine_with_depth(model, query, POSES[0])
    told = refine_with_depth(model, query, POSES[0], references=[far, empty])
    np.testing.assert_array_equal(told.world_from_camera, alone.world_from_camera)


def test_a_shift_within_its_noise_is_none(model):
    found = refine_with_depth(
        model, Query(camera=CAMERA, depth=see(POSES[0])), POSES[0], options=DepthRefinementOptions(starts="here")
    )
    known = found.uncertainty
    # One standard deviation off along one direction has χ² = 1, and 1 − 4/χ² is negative.
    little = np.concatenate([known.directions[0][:3], known.directions[0][3:] / known.radius_m])
    off = perturb(known.deviations_m[0] * little, found.world_from_camera, pivot_world=known.pivot_world)
    np.testing.assert_array_equal(reference_shift(frame(off, see(POSES[0])), found).twist, 0)
