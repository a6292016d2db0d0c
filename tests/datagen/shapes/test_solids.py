"""Closed shapes against formulas and against trimesh."""

import numpy as np
import pytest
import trimesh

from datagen.shapes.boxes import book, box
from datagen.shapes.lathe import SEGMENTS, lathe
from datagen.shapes.solid import enclosed_volume, triangles_of
from datagen.shapes.tube import tube

MUG = [(0, 0), (0.035, 0), (0.04, 0.09), (0.036, 0.09), (0.031, 0.005), (0, 0.005)]
SHAPES = {
    "mug": lambda: lathe(MUG, bevel=0.0015),
    "mug, drawn from the inside": lambda: lathe(MUG[::-1], bevel=0.0015),
    "ring": lambda: lathe([(0.03, 0), (0.032, 0), (0.032, 0.05), (0.03, 0.05), (0.03, 0)]),
    "apple": lambda: lathe([(0, 0.01), (0.02, 0), (0.04, 0.04), (0.02, 0.07), (0, 0.06)], spline=True),
    "round ring": lambda: lathe([(0.05, 0), (0.06, 0.01), (0.05, 0.02), (0.04, 0.01), (0.05, 0)], spline=True),
    "rod": lambda: tube([(0, 0, 0), (0.1, 0, 0.05), (0.1, 0.1, 0.1)], [0.01, 0.02, 0.005]),
    "handle": lambda: tube([(0, 0, 0), (0.03, 0, 0.01), (0.03, 0, 0.05), (0, 0, 0.06)], 0.005),
    "box": lambda: box((0.1, 0.2, 0.3)),
    "rounded box": lambda: box((0.1, 0.2, 0.3), bevel=0.02),
    "ball of a box": lambda: box((0.1, 0.1, 0.1), bevel=1.0),
    "book": lambda: book((0.15, 0.21, 0.03)),
}


def mesh_of(solid):
    return trimesh.Trimesh(solid.vertices, triangles_of(solid), process=False)


@pytest.mark.parametrize("name", SHAPES)
def test_every_shape_is_closed_and_faces_outwards(name):
    solid = SHAPES[name]()
    mesh = mesh_of(solid)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert all(piece.volume > 0 for piece in mesh.split(only_watertight=False))
    assert mesh.volume == pytest.approx(enclosed_volume(solid))
    assert not trimesh.Trimesh(solid.vertices, triangles_of(solid)).is_empty
    assert mesh.area_faces.min() > 0


@pytest.mark.parametrize("name", [name for name in SHAPES if name != "box"])
def test_shading_normals_are_unit_vectors_that_agree_with_the_faces_about(name):
    solid = SHAPES[name]()
    np.testing.assert_allclose(np.linalg.norm(solid.normals, axis=1), 1, atol=1e-9)
    assert np.einsum("ij,ij->i", mesh_of(solid).vertex_normals, solid.normals).min() > 0.9


@pytest.mark.parametrize("name", SHAPES)
def test_the_stretched_picture_covers_the_shape_once(name):
    solid = SHAPES[name]()
    assert len(solid.uv_unit) == len(solid.uv_metres) == len(solid.corners) == solid.sizes.sum()
    np.testing.assert_allclose([solid.uv_unit.min(), solid.uv_unit.max()], [0, 1], atol=0.03)


def test_a_turned_cylinder_has_the_volume_of_the_prism_that_approaches_it():
    radius, height, bevel = 0.5, 2.0, 1e-6
    prism = SEGMENTS / 2 * np.sin(2 * np.pi / SEGMENTS) * radius**2 * height
    cylinder = lathe([(0, 0), (radius, 0), (radius, height), (0, height)], bevel=bevel)
    assert enclosed_volume(cylinder) == pytest.approx(prism, rel=1e-5)


def test_a_rounded_corner_is_an_arc_of_its_radius_tangent_to_both_sides():
    bevel = 0.1
    cylinder = lathe([(0, 0), (1, 0), (1, 1), (0, 1)], bevel=bevel)
    r, z = np.hypot(cylinder.vertices[:, 0], cylinder.vertices[:, 1]), cylinder.vertices[:, 2]
    corner = (r > 1 - bevel + 1e-9) & (z < bevel - 1e-9)
    np.testing.assert_allclose(np.hypot(r[corner] - (1 - bevel), z[corner] - bevel), bevel, atol=1e-12)
    assert corner.sum() > 3 * SEGMENTS
    outward = np.stack([(r - (1 - bevel)), z - bevel])[:, corner] / bevel
    across = np.hypot(cylinder.normals[corner, 0], cylinder.normals[corner, 1])
    np.testing.assert_allclose([across, cylinder.normals[corner, 2]], outward, atol=1e-9)


def test_a_spline_goes_through_the_points_of_its_profile():
    profile = [(0, 0.01), (0.02, 0), (0.04, 0.04), (0.02, 0.07), (0, 0.06)]
    apple = lathe(profile, spline=True)
    places = np.stack([np.hypot(apple.vertices[:, 0], apple.vertices[:, 1]), apple.vertices[:, 2]], axis=-1)
    for point in profile:
        assert np.linalg.norm(places - point, axis=1).min() < 1e-9


def test_a_straight_tube_is_a_cylinder_between_half_balls():
    radius, length = 0.1, 1.0
    rod = tube([(0, 0, 0), (length, 0, 0)], radius)
    capsule = np.pi * radius**2 * (length + 4 / 3 * radius)
    assert enclosed_volume(rod) == pytest.approx(capsule, rel=0.02)
    from_axis = np.linalg.norm(rod.vertices - np.clip(rod.vertices * [1, 0, 0], 0, length), axis=1)
    np.testing.assert_allclose(from_axis, radius, atol=1e-9)


def test_a_rounded_box_is_at_its_bevel_from_a_smaller_box():
    size, bevel = np.array([0.1, 0.2, 0.3]), 0.02
    solid = box(tuple(size), bevel=bevel)
    core = np.clip(solid.vertices, bevel - size / 2, size / 2 - bevel)
    np.testing.assert_allclose(np.linalg.norm(solid.vertices - core, axis=1), bevel, atol=1e-12)
    np.testing.assert_allclose(np.abs(solid.vertices).max(axis=0), size / 2)


def test_a_box_shows_the_picture_upright_and_not_mirrored_on_each_side():
    solid = box((1.0, 2.0, 3.0))
    corners = solid.vertices[solid.corners].reshape(-1, 4, 3)
    for points, places in zip(corners, solid.uv_unit.reshape(-1, 4, 2), strict=True):
        # The surface's right and up, from how places change over it, and out of it: right-handed if not mirrored.
        edges, changes = points[1:3] - points[0], places[1:3] - places[0]
        right, up = np.linalg.solve(changes, edges)
        outwards = points.mean(axis=0)
        assert np.linalg.det([right, up, outwards]) > 0
        assert np.argmax(np.abs(up)) == (1 if abs(outwards[2]) > 1.4 else 2)


def test_a_cover_wraps_around_its_book_from_back_over_spine_to_front():
    width, height, thickness = 0.15, 0.21, 0.03
    solid = book((width, height, thickness))
    points = solid.vertices[solid.corners]
    cover = np.repeat(solid.slots == 0, solid.sizes)
    front = cover & (points[:, 2] > 0.49 * thickness)
    back = cover & (points[:, 2] < -0.49 * thickness)
    total = 2 * width + thickness
    np.testing.assert_allclose(
        solid.uv_unit[front, 0], (width + thickness + points[front, 0] + width / 2) / total, atol=1e-9
    )
    np.testing.assert_allclose(solid.uv_unit[back, 0], (width / 2 - points[back, 0]) / total, atol=1e-9)
    np.testing.assert_allclose(solid.uv_unit[cover, 1], points[cover, 1] / height + 0.5, atol=1e-9)
    assert set(solid.slots) == {0, 1}
    np.testing.assert_allclose(np.ptp(solid.vertices, axis=0), [width, height, thickness], atol=1e-9)
