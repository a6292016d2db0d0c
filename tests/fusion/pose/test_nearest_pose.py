import numpy as np
import pytest
import trimesh

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import look_at
from fusion.pose.located_record import pose_error
from fusion.pose.nearest_pose import find_nearest_pose
from fusion.pose.pose_distance import pose_distances
from fusion.pose.view_index import index_views
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

CAMERA = PinholeCamera(width=160, height=120, fx=160.0, fy=160.0, cx=79.5, cy=59.5)


@pytest.fixture(scope="module")
def surface():
    """Three boxes of different sizes: no view looks like another."""
    boxes = [((0.5, 0.3, 0.2), (0, 0, 0)), ((0.1, 0.1, 0.5), (0.2, 0.1, 0.1)), ((0.3, 0.08, 0.1), (-0.2, -0.15, 0.15))]
    parts = [
        trimesh.creation.box(extents=extents, transform=trimesh.transformations.translation_matrix(at))
        for extents, at in boxes
    ]
    shape = trimesh.util.concatenate(parts)
    return Mesh(vertices=np.asarray(shape.vertices, np.float32), triangles=np.asarray(shape.faces, np.int32))


def poses_on_a_circle(count):
    angles = np.arange(count) * 2 * np.pi / count
    return [look_at((np.cos(a), np.sin(a), 0.6 + 0.1 * np.sin(3 * a)), (0, 0, 0)) for a in angles]


def seen_from(surface, pose, device, camera=CAMERA):
    return cast_rays_at_mesh(surface, camera, [pose], device=device, depth_only=True).depth.numpy()[0]


def test_a_fused_view_is_nearest_to_itself(device, surface):
    poses = poses_on_a_circle(24)
    index = index_views(surface, poses, CAMERA, device=device)
    for number, pose in enumerate(poses):
        nearest = find_nearest_pose(index, seen_from(surface, pose, device))
        assert nearest.index == number
        assert nearest.scores[0] < 1e-9
        assert nearest.scores[0] == nearest.scores.min()
        rotation_deg, translation_m = pose_error(nearest.estimate, pose)
        assert rotation_deg < 0.05
        assert translation_m < 0.001


def test_a_view_between_two_is_nearest_to_the_closer(device, surface):
    poses = poses_on_a_circle(120)
    index = index_views(surface, poses[::10], CAMERA, device=device)
    for query in range(120):
        if query % 10 == 5:
            continue  # as close to one as to the other
        nearest = find_nearest_pose(index, seen_from(surface, poses[query], device))
        assert nearest.index == (query + 5) // 10 % 12, query
        assert set(nearest.indices[:2]) == {query // 10, (query // 10 + 1) % 12} or query % 10 == 0


def test_a_view_off_the_path_rolled_and_aimed_elsewhere_is_found(device, surface):
    rng = np.random.default_rng(3)
    poses = poses_on_a_circle(36)
    index = index_views(surface, poses, CAMERA, device=device)
    for _ in range(20):
        angle, height, reach = rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 0.9), rng.uniform(0.9, 1.2)
        pose = look_at((reach * np.cos(angle), reach * np.sin(angle), height), rng.normal(scale=0.08, size=3))
        pose = pose @ trimesh.transformations.rotation_matrix(rng.normal(scale=0.1), (0, 0, 1))
        depth = seen_from(surface, pose, device)
        if (depth[[0, -1]] > 0).any() or (depth[:, [0, -1]] > 0).any():
            continue  # cut off by the image's edge
        distances = pose_distances(np.stack(poses), pose, depth=float(np.median(depth[depth > 0])))
        nearest = find_nearest_pose(index, depth)
        assert distances[nearest.index] <= 1.1 * distances.min()
        assert not nearest.ambiguous


def test_noise_and_missing_pixels_leave_the_nearest_what_it_is(device, surface):
    rng = np.random.default_rng(5)
    poses = poses_on_a_circle(60)
    index = index_views(surface, poses[::5], CAMERA, device=device)
    for query in range(1, 60, 5):
        depth = seen_from(surface, poses[query], device)
        noisy = np.where(depth > 0, depth + rng.normal(scale=0.004, size=depth.shape), 0)
        noisy[rng.random(depth.shape) < 0.2] = 0
        assert find_nearest_pose(index, noisy.astype(np.float32)).index == query // 5


def test_what_the_mask_leaves_out_may_hide_the_model(device, surface):
    poses = poses_on_a_circle(24)
    index = index_views(surface, poses, CAMERA, device=device)
    for number in range(0, 24, 3):
        depth = seen_from(surface, poses[number], device)
        columns = np.nonzero((depth > 0).any(axis=0))[0]
        mask = np.ones(depth.shape, bool)
        mask[:, : columns[0] + (columns[-1] - columns[0]) * 3 // 10] = False  # a hand before the left 30 %
        depth[~mask] = 0.3
        assert find_nearest_pose(index, depth, mask=mask).index == number


def test_an_object_that_looks_alike_from_two_sides_is_said_to(device):
    box = trimesh.creation.box((0.5, 0.3, 0.2))
    mesh = Mesh(vertices=np.asarray(box.vertices, np.float32), triangles=np.asarray(box.faces, np.int32))
    poses = poses_on_a_circle(24)
    index = index_views(mesh, poses, CAMERA, device=device)
    pose = look_at((0.9, 0.5, 0.7), (0, 0, 0))
    nearest = find_nearest_pose(index, seen_from(mesh, pose, device))
    assert nearest.ambiguous
    assert nearest.margin < 0.1
    # Half a turn about the vertical leaves the box as it is: both poses are handed on.
    half_a_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    found = np.stack([nearest.estimate, *nearest.others])
    for truth in (pose, half_a_turn @ pose):
        assert pose_distances(found, truth, depth=1.2).min() < 0.01


def test_a_query_between_views_far_apart_that_something_hides_in_part_is_found(device, surface):
    poses = poses_on_a_circle(120)
    index = index_views(surface, poses[::20], CAMERA, device=device)  # 60° from each to the next
    for query in range(5, 120, 23):
        depth = seen_from(surface, poses[query], device)
        columns = np.nonzero((depth > 0).any(axis=0))[0]
        mask = np.ones(depth.shape, bool)
        mask[:, : columns[0] + (columns[-1] - columns[0]) * 3 // 10] = False
        nearest = find_nearest_pose(index, np.where(mask, depth, np.float32(0.3)), mask=mask & (depth > 0))
        distances = pose_distances(index.world_from_camera, poses[query], depth=1.2)
        assert nearest.index == distances.argmin()
        rotation_deg, translation_m = pose_error(nearest.estimate, poses[query])
        # From within 10° and 4 cm every refinement has to come right.
        assert rotation_deg < 10
        assert translation_m < 0.04


def test_distances_between_poses_are_angles_and_shifts_at_depth():
    pose = look_at((0, -2, 0), (0, 0, 0))
    turned = pose @ trimesh.transformations.rotation_matrix(np.radians(170), (0.3, 0.5, 0.8))
    shifted = pose.copy()
    shifted[:3, 3] += (0.3, 0, 0.4)
    distances = pose_distances(np.stack([pose, turned, shifted]), pose, depth=2.0)
    np.testing.assert_allclose(distances, [0, np.radians(170), 0.25], atol=1e-12)


def test_a_query_without_depth_is_an_error(device, surface):
    index = index_views(surface, poses_on_a_circle(3), CAMERA, device=device)
    with pytest.raises(InputError, match="no pixel has a valid depth"):
        find_nearest_pose(index, np.zeros((120, 160), np.float32))
    depth = seen_from(surface, poses_on_a_circle(3)[0], device)
    with pytest.raises(InputError, match="no pixel inside the mask has a valid depth"):
        find_nearest_pose(index, depth, mask=depth == 0)


def test_pose_errors_are_an_angle_and_a_distance():
    truth = look_at((1, 2, 3), (0, 0, 0))
    turn = np.eye(4)
    turn[:3, :3] = trimesh.transformations.rotation_matrix(np.radians(7), (0.3, 0.5, 0.8))[:3, :3]
    moved = truth @ turn
    moved[:3, 3] += (0.03, 0, 0.04)
    rotation_deg, translation_m = pose_error(moved, truth)
    assert rotation_deg == pytest.approx(7)
    assert translation_m == pytest.approx(0.05)
