import numpy as np
import pytest
from boxes import POSES, boxes, see_boxes
from scipy import ndimage
from three_balls import CAMERA

from fusion.pose.overlay import AFTER, before_and_after, depth_as_grey, draw_edges, model_edges, stacked
from fusion.surface.mesh import Mesh

IMAGE = np.full((CAMERA.height, CAMERA.width, 3), 100, np.uint8)


def test_the_outline_is_the_silhouettes_border(device):
    for pose in POSES:
        mask = see_boxes(pose, device) > 0
        edges = model_edges(boxes(), CAMERA, pose, device=device)
        border = mask & ~ndimage.binary_erosion(mask, border_value=1)
        assert edges[border].all()
        assert not edges[~mask].any()
        assert (edges & ~border).sum() < border.sum()  # of the rest, only where a box hides another


def test_one_box_before_another_has_an_edge_within_the_silhouette(device):
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    # A small square at 1 m before a large one at 2 m, seen by a camera at the origin that looks along z.
    vertices = np.concatenate([0.1 * corners + [0, 0, 1], 0.5 * corners + [0, 0, 2]]).astype(np.float32)
    quads = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    mesh = Mesh(vertices=vertices, triangles=np.concatenate([quads, quads + 4]))
    edges = model_edges(mesh, CAMERA, np.eye(4), device=device)
    u, v = CAMERA.project(np.array([0.1, 0.0, 1.0]))
    assert edges[round(v), int(u)]  # the last pixel of the small square to the right
    assert not edges[round(v), int(u) + 2]
    assert edges.sum() == pytest.approx(2 * (0.2 + 0.5) * (170 + 165), rel=0.05)


def test_a_model_that_is_not_seen_has_no_edges(device):
    away = POSES[0].copy()
    away[:3, :3] = away[:3, :3] @ np.diag([-1.0, 1, -1])
    assert not model_edges(boxes(), CAMERA, away, device=device).any()


def test_drawing_leaves_the_query_as_it_was(device):
    kept = IMAGE.copy()
    picture = before_and_after(IMAGE, boxes(), CAMERA, POSES[0], POSES[1], device=device)
    np.testing.assert_array_equal(IMAGE, kept)
    assert picture.shape == (CAMERA.height, 2 * CAMERA.width + 4, 3)
    after = picture[:, CAMERA.width + 4 :]
    edges = model_edges(boxes(), CAMERA, POSES[1], device=device)
    assert (after[edges][:, 1] > 200).all()
    assert stacked([picture, picture]).shape == (2 * CAMERA.height + 4, picture.shape[1], 3)
    assert (draw_edges(IMAGE, edges, color=AFTER)[edges] == AFTER).all()


def test_near_depth_is_brighter_than_far_and_invalid_is_black():
    grey = depth_as_grey(np.array([[0.0, 1.0], [2.0, 1.5]], np.float32))[..., 0]
    assert grey[0, 0] == 0
    assert grey[0, 1] > grey[1, 1] > grey[1, 0] > 0
    assert not depth_as_grey(np.zeros((2, 2), np.float32)).any()
