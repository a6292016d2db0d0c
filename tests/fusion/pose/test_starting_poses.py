import numpy as np
from scipy.spatial.transform import Rotation
from three_balls import CAMERA, OFFSET, POSES, ball_model, see, twist

from datagen.camera import PinholeCamera
from datagen.rigid import inverse, transform_points
from fusion.pose.depth_problem import depth_problem
from fusion.pose.pose_distance import first_apart, pose_distances
from fusion.pose.query import Query, query_cloud
from fusion.pose.se3 import perturb
from fusion.pose.starting_poses import shifted_onto_depth, starts_all_about, turns_within


def test_no_turn_up_to_the_largest_is_far_from_all_that_are_tried():
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(500, 3))
    turns = axes / np.linalg.norm(axes, axis=1, keepdims=True) * np.radians(45 * rng.random((500, 1)) ** (1 / 3))
    tried = Rotation.from_rotvec(turns_within(45.0, apart_deg=30.0)[:, 3:])
    apart = [np.degrees((Rotation.from_rotvec(turn) * tried.inv()).magnitude().min()) for turn in turns]
    assert max(apart) < 15
    # As few as a lattice needs: the ball's volume over those of balls of 15°, times the covering's density, 1.46.
    assert len(tried) < 2 * 1.46 * (45 / 15) ** 3


def test_starts_within_a_scene_leave_no_large_error_uncovered(device):
    model = ball_model(device)
    rng = np.random.default_rng(1)
    starts = starts_all_about(model, POSES[0], None)
    # Of shifts by 0.12 to six sides, those of 0.16 along a diagonal are the farthest.
    farthest = np.sqrt(0.12**2 + 0.16**2 - 2 * 0.12 * 0.16 / 3**0.5)
    for _ in range(40):
        truth = perturb(twist(rng, 40.0, 0.0), POSES[0], pivot_world=model.centre_world)
        truth[:3, 3] += 0.16 * twist(rng, 1.0, 1.0)[:3]
        turned = Rotation.from_matrix(np.swapaxes(starts[:, :3, :3], 1, 2) @ truth[:3, :3]).magnitude()
        middle = transform_points(inverse(truth), model.centre_world)
        moved = np.linalg.norm(starts[:, :3, :3] @ middle + starts[:, :3, 3] - model.centre_world, axis=1)
        assert moved[turned < np.radians(15)].min() < farthest + 1e-6


def test_a_model_in_sight_is_shifted_to_where_the_depth_is(device):
    model = ball_model(device)
    for number, truth in enumerate(POSES):
        start = truth.copy()
        start[:3, 3] += 0.16 * twist(np.random.default_rng(number), 1.0, 1.0)[:3]
        points = query_cloud(Query(camera=CAMERA, depth=see(truth)), device=device).points_camera
        shifted = shifted_onto_depth(model, start[None], points)[0]
        # As near as the starts from which every descent has to come right.
        assert np.linalg.norm(shifted[:3, 3] - truth[:3, 3]) < 0.04


def test_a_view_that_the_images_edge_cuts_off_is_told_from_an_object_in_sight(device):
    model = ball_model(device)
    depth = see(POSES[0])
    rows, columns = np.nonzero(depth)
    top, left = int(rows.mean()), int(columns.mean())
    part = np.ascontiguousarray(depth[top:, left:])
    corner = PinholeCamera(
        width=part.shape[1], height=part.shape[0], fx=CAMERA.fx, fy=CAMERA.fy, cx=CAMERA.cx - left, cy=CAMERA.cy - top
    )
    for camera, image, is_cut in ((CAMERA, depth, False), (corner, part, True)):
        query = Query(camera=camera, depth=image)
        assert depth_problem(model, query, query_cloud(query, device=device), POSES[0]).is_cut == is_cut


def test_the_first_poses_that_lie_apart_are_chosen_in_their_order():
    poses = np.stack([perturb(np.radians([0, 0, 0, turn, 0, 0]), POSES[0], pivot_world=OFFSET) for turn in range(60)])
    order = np.random.default_rng(2).permutation(60)
    chosen = first_apart(poses[order], apart=0.3, depth=0.7)
    assert chosen[0] == 0
    for place, one in enumerate(chosen):
        distances = pose_distances(poses[order], poses[order][one], depth=0.7)
        assert (distances[chosen[:place]] >= 0.3).all()
    # What is left out is near one that was chosen before it.
    for one in set(range(60)) - set(chosen.tolist()):
        before = chosen[chosen < one]
        assert pose_distances(poses[order][before], poses[order][one], depth=0.7).min() < 0.3
    np.testing.assert_array_equal(first_apart(poses[order], apart=0.3, depth=0.7, most=2), chosen[:2])
