from dataclasses import replace

import numpy as np
import pytest
from boxes import POSES as BOX_POSES
from boxes import see_boxes
from three_balls import CAMERA, OFFSET, POSES, ball_model, see, twist

from fusion.pose.depth_refinement import refine_with_depth
from fusion.pose.epipolar import rectify
from fusion.pose.evidence import Evidence, gather_evidence
from fusion.pose.query import Query
from fusion.pose.refinement import Refinement
from fusion.pose.se3 import perturb
from fusion.pose.silhouette_refinement import refine_with_silhouette
from fusion.pose.verdict import judge, judge_nearest, quality


@pytest.fixture
def balls(device):
    return ball_model(device)


def verdict_of(model, query, refined):
    return judge(refined, gather_evidence(model, query, refined.world_from_camera))


@pytest.mark.parametrize("with_mask", [True, False])
def test_the_right_object_is_found_and_another_is_not(device, balls, with_mask):
    for i, pose in enumerate(POSES):
        start = perturb(twist(np.random.default_rng(i), 8.0, 0.03), pose, pivot_world=OFFSET)
        depth = see(pose)
        query = Query(camera=CAMERA, depth=depth, mask=depth > 0 if with_mask else None)
        assert verdict_of(balls, query, refine_with_depth(balls, query, start)).answer == "found"
        # Boxes, seen from as far and brought to where the balls are.
        other = see_boxes(BOX_POSES[i], device)
        query = Query(camera=CAMERA, depth=other, mask=other > 0 if with_mask else None)
        verdict = verdict_of(balls, query, refine_with_depth(balls, query, start))
        assert verdict.answer == "not found"
        assert "depth is the model's at" in verdict.reasons[0]


def test_an_outline_of_another_object_is_not_found(device, balls):
    query = Query(camera=CAMERA, mask=see_boxes(BOX_POSES[0], device) > 0)
    assert verdict_of(balls, query, refine_with_silhouette(balls, query, POSES[0])).answer == "not found"


def test_an_empty_mask_is_not_found_and_says_why(balls):
    query = Query(camera=CAMERA, depth=see(POSES[0]), mask=np.zeros((120, 160), bool))
    for refined in (refine_with_depth(balls, query, POSES[0]), refine_with_silhouette(balls, query, POSES[0])):
        verdict = verdict_of(balls, query, refined)
        assert verdict.answer == "not found"
        assert "mask" in verdict.reasons[0]
    assert verdict_of(balls, query, rectify(balls, query, [], POSES[0])).answer == "not found"


ALL = Evidence(covered=1, filled=1, agreeing=1, free=0, slopes=1, pixels=1000, depth_pixels=1000)


def test_what_did_not_settle_is_doubtful():
    settled = Refinement(stage="depth", world_from_camera=np.eye(4), converged=True)
    assert judge(settled, ALL).answer == "found"
    verdict = judge(replace(settled, converged=False, reason="its last step was still 2 mm"), ALL)
    assert verdict.answer == "doubtful"
    assert verdict.reasons == ("its last step was still 2 mm",)


def test_every_share_alone_can_refuse_a_pose_and_what_is_not_known_cannot():
    assert quality(ALL) == 1
    for name, bad in (("covered", 0.3), ("filled", 0.3), ("agreeing", 0.3), ("free", 0.7), ("slopes", 0.3)):
        assert quality(replace(ALL, **{name: bad})) == pytest.approx(0.3)
        assert quality(replace(ALL, **{name: None})) == 1
    assert quality(Evidence()) == 0


def test_a_nearest_pose_alone_is_doubtful_where_it_fits_poorly_or_is_ambiguous():
    assert judge_nearest(0.1, ambiguous=False).answer == "found"
    assert judge_nearest(0.9, ambiguous=False).answer == "doubtful"
    assert judge_nearest(0.1, ambiguous=True).answer == "doubtful"
