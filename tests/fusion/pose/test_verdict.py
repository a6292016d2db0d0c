from dataclasses import replace

import numpy as np
import pytest
from boxes import POSES as BOX_POSES
from boxes import see_boxes
from three_balls import CAMERA, OFFSET, POSES, ball_model, see, twist

from fusion.pose.depth_refinement import refine_with_depth
from fusion.pose.epipolar import rectify
from fusion.pose.query import Query
from fusion.pose.refinement import Refinement
from fusion.pose.se3 import perturb
from fusion.pose.silhouette_refinement import refine_with_silhouette
from fusion.pose.verdict import judge


@pytest.fixture
def balls(device):
    return ball_model(device)


@pytest.mark.parametrize("with_mask", [True, False])
def test_the_right_object_is_found_and_another_is_not(device, balls, with_mask):
    for i, pose in enumerate(POSES):
        start = perturb(twist(np.random.default_rng(i), 8.0, 0.03), pose, pivot_world=OFFSET)
        depth = see(pose)
        query = Query(camera=CAMERA, depth=depth, mask=depth > 0 if with_mask else None)
        assert judge(refine_with_depth(balls, query, start)).answer == "found"
        # Boxes, seen from as far and brought to where the balls are.
        other = see_boxes(BOX_POSES[i], device)
        query = Query(camera=CAMERA, depth=other, mask=other > 0 if with_mask else None)
        verdict = judge(refine_with_depth(balls, query, start))
        assert verdict.answer == "not found"
        assert "of the query's points" in verdict.reasons[0]


def test_an_outline_of_another_object_is_not_found(device, balls):
    query = Query(camera=CAMERA, mask=see_boxes(BOX_POSES[0], device) > 0)
    assert judge(refine_with_silhouette(balls, query, POSES[0])).answer == "not found"


def test_an_empty_mask_is_not_found_and_says_why(balls):
    query = Query(camera=CAMERA, depth=see(POSES[0]), mask=np.zeros((120, 160), bool))
    for refined in (refine_with_depth(balls, query, POSES[0]), refine_with_silhouette(balls, query, POSES[0])):
        verdict = judge(refined)
        assert verdict.answer == "not found"
        assert "mask" in verdict.reasons[0]
    assert judge(rectify(balls, query, [], POSES[0])).answer == "not found"


def test_what_did_not_settle_is_doubtful():
    settled = Refinement(stage="depth", world_from_camera=np.eye(4), converged=True, score=0.95, overlap=0.9)
    assert judge(settled).answer == "found"
    verdict = judge(replace(settled, converged=False, reason="its last step was still 2 mm"))
    assert verdict.answer == "doubtful"
    assert verdict.reasons == ("its last step was still 2 mm",)
