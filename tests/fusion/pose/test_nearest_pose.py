import numpy as np
import pytest
import trimesh

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import look_at
from fusion.pose.locate import pose_error
from fusion.pose.nearest_pose import find_nearest_pose, view_surface
from fusion.surface.mesh import Mesh

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


def test_the_model_is_seen_at_pixel_centres_in_planar_depth(device):
    # A plane z = 2.5 before a camera at the origin has depth 2.5 at every pixel, whatever the ray's length.
    plane = Mesh(
        vertices=np.array([[-9, -9, 2.5], [9, -9, 2.5], [9, 9, 2.5], [-9, 9, 2.5]], np.float32),
        triangles=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    )
    views = view_surface(plane, [np.eye(4)], CAMERA, device=device)
    np.testing.assert_allclose(views.depth.numpy(), 2.5, rtol=1e-6)
    # Its edge falls where the projection has it, to the pixel.
    half = Mesh(vertices=plane.vertices - np.array([9, 0, 0], np.float32), triangles=plane.triangles)
    seen = view_surface(half, [np.eye(4)], CAMERA, device=device).depth.numpy()[0] > 0
    columns = np.arange(0, CAMERA.width, views.step)
    np.testing.assert_array_equal(seen[0], columns <= CAMERA.cx)


def test_a_fused_view_is_nearest_to_itself(device, surface):
    poses = poses_on_a_circle(24)
    views = view_surface(surface, poses, CAMERA, device=device)
    full = view_surface(
        surface, poses, PinholeCamera(width=80, height=60, fx=80, fy=80, cx=39.75, cy=29.75), device=device
    )
    for index in range(len(poses)):
        depth = np.repeat(np.repeat(full.depth.numpy()[index], views.step, 0), views.step, 1)
        nearest = find_nearest_pose(views, depth)
        assert nearest.index == index
        assert nearest.scores[index] < 1e-9


def test_a_view_between_two_is_nearest_to_the_closer(device, surface):
    poses = poses_on_a_circle(120)
    fused = poses[::10]
    views = view_surface(surface, fused, CAMERA, device=device)
    for query in range(120):
        offset = query % 10
        if 3 < offset < 7:
            continue  # nearly as close to one as to the other
        small = view_surface(surface, [poses[query]], CAMERA, device=device).depth.numpy()[0]
        nearest = find_nearest_pose(views, np.repeat(np.repeat(small, views.step, 0), views.step, 1))
        assert nearest.index == (query + 5) // 10 % 12, query


def test_a_query_without_depth_is_an_error(device, surface):
    views = view_surface(surface, poses_on_a_circle(3), CAMERA, device=device)
    with pytest.raises(InputError, match="no pixel has a valid depth"):
        find_nearest_pose(views, np.zeros((120, 160), np.float32))


def test_pose_errors_are_an_angle_and_a_distance():
    truth = look_at((1, 2, 3), (0, 0, 0))
    turn = np.eye(4)
    turn[:3, :3] = trimesh.transformations.rotation_matrix(np.radians(7), (0.3, 0.5, 0.8))[:3, :3]
    moved = truth @ turn
    moved[:3, 3] += (0.03, 0, 0.04)
    rotation_deg, translation_m = pose_error(moved, truth)
    assert rotation_deg == pytest.approx(7)
    assert translation_m == pytest.approx(0.05)
