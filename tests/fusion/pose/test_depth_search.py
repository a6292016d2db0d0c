import numpy as np
import pytest
from three_balls import CAMERA, OFFSET, POSES, ball_model, errors, see, twist

from datagen.camera import PinholeCamera
from fusion.pose.depth_refinement import DepthRefinementOptions, refine_with_depth
from fusion.pose.query import Query
from fusion.pose.se3 import perturb


def test_of_the_poses_that_a_search_has_found_the_one_that_explains_the_view_is_refined(device):
    model = ball_model(device)
    truth = POSES[0]
    wrong = [
        perturb(np.array([0, 0, 0, *turn]), truth, pivot_world=OFFSET) for turn in np.radians([[0, 0, 150], [90, 0, 0]])
    ]
    near = perturb(twist(np.random.default_rng(0), 3.0, 0.01), truth, pivot_world=OFFSET)
    query = Query(camera=CAMERA, depth=see(truth))
    found = refine_with_depth(model, query, wrong[0], others=[wrong[1], near])
    angle, distance = errors(found.world_from_camera, truth)
    assert angle < 0.06
    assert distance < 1e-4
    # The first is kept where another explains the view no better: from here on both lead to the same.
    kept = refine_with_depth(model, query, near, others=[truth])
    alone = refine_with_depth(model, query, near, others=[])
    np.testing.assert_allclose(kept.world_from_camera, alone.world_from_camera, atol=1e-5)


@pytest.mark.parametrize(("number", "axis", "shift"), [(0, 1, 0.16), (1, 0, 0.2), (2, 2, 0.2)])
def test_a_pose_that_slid_where_the_image_cuts_off_what_is_seen_is_brought_back(device, number, axis, shift):
    model, truth = ball_model(device), POSES[number]
    depth = see(truth)
    rows, columns = np.nonzero(depth)
    top, left = int(np.quantile(rows, 0.3)), int(np.quantile(columns, 0.3))
    part = np.ascontiguousarray(depth[top:, left:])
    height, width = part.shape
    corner = PinholeCamera(
        width=width, height=height, fx=CAMERA.fx, fy=CAMERA.fy, cx=CAMERA.cx - left, cy=CAMERA.cy - top
    )
    query = Query(camera=corner, depth=part)
    start = truth.copy()
    start[axis, 3] += shift
    alone = refine_with_depth(model, query, start, others=[], options=DepthRefinementOptions(starts="one"))
    found = refine_with_depth(model, query, start, others=[])
    # A ball in sight fixes where it is, and not how it is turned.
    assert errors(alone.world_from_camera, truth)[1] > 0.05
    assert errors(found.world_from_camera, truth)[1] < 1e-3
