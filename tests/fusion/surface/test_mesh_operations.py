import numpy as np
import pytest
import trimesh
from dense_volume import lattice, volume_of

from datagen.errors import InputError
from fusion.devices import resolve_device
from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_operations import decimate, holes, largest_component, smooth, without_small_components

CPU = resolve_device("cpu")


def as_mesh(shape, colors=None):
    return Mesh(
        vertices=np.asarray(shape.vertices, np.float32), triangles=np.asarray(shape.faces, np.int32), colors=colors
    )


def as_trimesh(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)


def three_spheres():
    # The largest has the fewest triangles.
    parts = [trimesh.creation.icosphere(subdivisions=n, radius=r) for n, r in ((1, 1.0), (3, 0.2), (2, 0.4))]
    for i, part in enumerate(parts):
        part.apply_translation((3 * i, 0, 0))
    return as_mesh(trimesh.util.concatenate(parts))


def test_the_largest_component_is_the_one_with_the_largest_area():
    kept = largest_component(three_spheres())
    assert len(kept.triangles) == 80
    np.testing.assert_allclose(np.linalg.norm(kept.vertices, axis=1), 1, atol=1e-6)


def test_components_below_a_number_of_triangles_go_and_the_others_stay_whole():
    kept = without_small_components(three_spheres(), 320)
    assert len(kept.triangles) == 1280 + 320
    assert as_trimesh(kept).is_watertight
    with pytest.raises(InputError, match="the largest has 1,280"):
        without_small_components(three_spheres(), 1281)


def test_parts_agree_with_trimesh():
    mesh = three_spheres()
    areas = sorted(part.area for part in as_trimesh(mesh).split(only_watertight=False))
    assert as_trimesh(largest_component(mesh)).area == pytest.approx(areas[-1])


def test_a_closed_mesh_has_no_holes():
    assert holes(three_spheres()) == []


def test_holes_have_their_lengths_and_centres():
    # A cylinder without its caps has two circles.
    around, radius, height = 64, 0.5, 2.0
    angles = 2 * np.pi * np.arange(around) / around
    ring = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    vertices = np.concatenate([np.c_[ring, np.zeros(around)], np.c_[ring, np.full(around, height)]])
    i, j = np.arange(around), (np.arange(around) + 1) % around
    triangles = np.concatenate([np.stack([i, j, j + around], 1), np.stack([i, j + around, i + around], 1)])
    found = holes(Mesh(vertices=vertices.astype(np.float32), triangles=triangles.astype(np.int32)))
    assert [hole.edges for hole in found] == [around, around]
    chord = 2 * radius * np.sin(np.pi / around)
    np.testing.assert_allclose([hole.length for hole in found], around * chord, rtol=1e-6)
    assert sorted(hole.centre[2] for hole in found) == pytest.approx([0, height])
    np.testing.assert_allclose([hole.centre[:2] for hole in found], 0, atol=1e-7)


def test_smoothing_takes_noise_away_and_keeps_the_volume():
    shape = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    rng = np.random.default_rng(0)
    noisy = shape.vertices * (1 + rng.normal(scale=0.01, size=(len(shape.vertices), 1)))
    mesh = Mesh(vertices=noisy.astype(np.float32), triangles=np.asarray(shape.faces, np.int32))
    result = smooth(mesh, 10)
    before, after = (np.linalg.norm(m.vertices, axis=1).std() for m in (mesh, result))
    assert after < before / 2
    assert as_trimesh(result).volume == pytest.approx(as_trimesh(mesh).volume, rel=5e-3)


def test_smoothing_keeps_the_large_shape():
    shape = trimesh.creation.icosphere(subdivisions=4)
    x, y, z = shape.vertices.T
    ripple = shape.vertices * (1 + 0.1 * (x * y + y * z))[:, None]
    result = smooth(Mesh(vertices=ripple.astype(np.float32), triangles=np.asarray(shape.faces, np.int32)), 10)
    # Vertices slide along the surface where the triangles are uneven; the surface itself stays.
    radius = np.linalg.norm(result.vertices, axis=1)
    x, y, z = result.vertices.T / radius
    np.testing.assert_allclose(radius, 1 + 0.1 * (x * y + y * z), atol=0.002)


def test_smoothing_leaves_the_border_where_it_is():
    shape = trimesh.creation.icosphere(subdivisions=3)
    half = trimesh.Trimesh(shape.vertices, shape.faces[shape.triangles_center[:, 2] > 0])
    mesh = as_mesh(half)
    border = np.unique(half.edges_sorted[trimesh.grouping.group_rows(half.edges_sorted, require_count=1)])
    result = smooth(mesh, 5)
    np.testing.assert_array_equal(result.vertices[border], mesh.vertices[border])
    inner = np.setdiff1d(np.arange(len(mesh.vertices)), border)
    assert (result.vertices[inner] != mesh.vertices[inner]).any(axis=1).mean() > 0.9


def test_decimation_reaches_its_target_near_the_surface_with_the_colours_of_the_place():
    shape = trimesh.creation.icosphere(subdivisions=5, radius=2.0)
    shape.apply_translation((1000, 0, 0))  # far from the origin, where single precision is coarse
    colors = np.rint((shape.vertices - (1000, 0, 0)) / 2 * 100 + 128).astype(np.uint8)
    result = decimate(as_mesh(shape, colors), 2000, device=CPU)
    assert len(result.triangles) == pytest.approx(2000, rel=0.01)
    assert as_trimesh(result).is_watertight
    away = result.vertices.astype(np.float64) - (1000, 0, 0)
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 2, atol=0.01)
    expected = away / np.linalg.norm(away, axis=1, keepdims=True) * 100 + 128
    assert np.abs(result.colors - expected).max() < 2


def test_a_surface_through_voxels_is_decimated_like_any_other():
    # An octahedron: marching cubes meets voxels everywhere, and has triangles without area there.
    distance = np.abs(lattice(32) - 16).sum(axis=-1) - 12
    mesh = marching_cubes(volume_of(distance / 40, CPU, color=8 * lattice(32)))
    corners = mesh.vertices[mesh.triangles]
    assert (corners == np.roll(corners, 1, axis=1)).all(axis=2).any(axis=1).sum() > 100
    result = decimate(mesh, len(mesh.triangles) // 10, device=CPU)
    assert len(result.triangles) <= 1.1 * len(mesh.triangles) / 10
    np.testing.assert_allclose(np.abs(result.vertices - 16).sum(axis=1), 12, atol=0.5)  # half a voxel
    np.testing.assert_allclose(result.colors, 8 * result.vertices, atol=8 * 0.5)


@pytest.mark.parametrize("target", [3, 0, 10**6])
def test_a_target_that_cannot_be_reached_is_refused(target):
    with pytest.raises(InputError, match="cannot decimate"):
        decimate(three_spheres(), target, device=CPU)
