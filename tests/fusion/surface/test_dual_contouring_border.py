"""Where dual contouring ends: at the border of the cells that were seen, as marching cubes does."""

import numpy as np
import pytest
from analytic_oracle import ball, cube, random_solid
from dense_volume import closed_random_field, lattice, volume_of
from mesh_topology import edge_uses, is_manifold, self_intersections
from scipy.spatial import cKDTree

from fusion.surface.dual_contouring.dual_contouring import dual_contouring
from fusion.surface.marching_cubes import marching_cubes

VOXEL_SIZE = 0.07
BLOCKS = 5
"""The fields' sides; the world's origin is in the middle of them."""


def corners(voxel_size=VOXEL_SIZE):
    """Return the lattice points of a field (8 BLOCKS, …, 3) in metres, and its first block."""
    first = -(BLOCKS // 2)
    return voxel_size * (lattice(8 * BLOCKS) + 8 * first), (first,) * 3


def masked(solid, weight, device, *, voxel_size=VOXEL_SIZE):
    """Return a solid's volume of which what has weight was seen."""
    points, first_block = corners(voxel_size)
    field = np.clip(solid(points.reshape(-1, 3)).reshape(points.shape[:3]), -1, 1)
    return volume_of(field, device, weight=weight, voxel_size=voxel_size, first_block=first_block)


def random_mask(rng):
    """Return weights: of one side of a plane, but for some voxels, what was seen."""
    points, _ = corners()
    way = rng.normal(size=3)
    return ((points @ way < 0.3 * np.linalg.norm(way)) & (rng.random(points.shape[:3]) < 0.98)).astype(float)


def seen_cells(weight):
    """Return which cells have eight seen corners; with unseen ones around."""
    seen = np.ones([n - 1 for n in weight.shape], bool)
    for c in range(8):
        seen &= weight[tuple(slice(c >> a & 1, n - 1 + (c >> a & 1)) for a, n in enumerate(weight.shape))] > 0
    return np.pad(seen, 1)


def border_segments(mesh):
    """Return the ends (n, 2, 3) of a mesh's border edges, in voxels from its field's first."""
    edges, uses = edge_uses(mesh)
    return mesh.vertices.astype(float)[edges[uses == 1]] / VOXEL_SIZE + 8 * (BLOCKS // 2)


def lies_between_seen_and_unseen(points, seen):
    """Return whether points, in voxels, lie on a face with a seen cell on one side and none on the other."""
    found = np.zeros(len(points), bool)
    cells = np.floor(points).astype(int)
    for axis in range(3):
        nearest = np.round(points[:, axis]).astype(int)
        after = cells.copy()
        after[:, axis] = nearest
        before = after - np.eye(3, dtype=int)[axis]
        differ = seen[tuple((after + 1).T)] != seen[tuple((before + 1).T)]
        found |= differ & (np.abs(points[:, axis] - nearest) < 1e-4)
    return found


@pytest.mark.parametrize("seed", range(4))
def test_solids_of_which_a_part_was_seen_give_manifolds_that_end_where_it_ends(device, seed):
    rng = np.random.default_rng(seed)
    solid, weight = random_solid(rng), random_mask(rng)
    volume = masked(solid, weight, device)
    seen = seen_cells(weight)
    for oracle in (None, solid.oracle(VOXEL_SIZE, device)):
        mesh = dual_contouring(volume, oracle=oracle, normals=True)
        assert is_manifold(mesh)
        assert self_intersections(mesh) == 0
        np.testing.assert_array_equal(np.unique(mesh.triangles), np.arange(len(mesh.vertices)))
        segments = border_segments(mesh)
        assert len(segments) > 100
        # Ends of segments lie on lattice edges, where faces of several ways meet.
        assert lies_between_seen_and_unseen(segments.mean(1), seen).all()


@pytest.mark.parametrize("seed", range(4))
def test_the_border_is_that_of_marching_cubes(device, seed):
    rng = np.random.default_rng(seed)
    volume = masked(random_solid(rng), random_mask(rng), device)
    ours, cubes = (border_segments(mesher(volume)) for mesher in (dual_contouring, marching_cubes))
    assert len(ours) == len(cubes)
    ends = np.concatenate([cubes, cubes[:, ::-1]]).reshape(-1, 6)
    away, found = cKDTree(ends).query(ours.reshape(-1, 6))
    assert away.max() < 2 * np.sqrt(2) * 1e-3  # either end keeps 1e-3 from voxels
    assert len(np.unique(found % len(cubes))) == len(ours)


def area(mesh):
    a, b, c = np.moveaxis(mesh.vertices.astype(float)[mesh.triangles], 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


@pytest.mark.parametrize("seed", range(3))
def test_of_a_plane_as_much_is_covered_as_by_marching_cubes(device, seed):
    rng = np.random.default_rng(seed)
    way = rng.normal(size=3)
    field = (lattice(20) - 9.7) @ (way / np.linalg.norm(way)) / 30
    volume = volume_of(field, device, weight=(rng.random(field.shape) < 0.95).astype(float))
    mesh, cubes = dual_contouring(volume), marching_cubes(volume)
    assert len(mesh.triangles) > 500
    assert area(mesh) == pytest.approx(area(cubes), rel=2e-3)


@pytest.mark.parametrize("share", [0.97, 0.7])
def test_noise_of_which_voxels_are_unseen_gives_a_manifold_that_never_meets_itself(device, share):
    # Every sign pattern, and seen cells that touch unseen ones, or each other, in all ways.
    weight = (np.random.default_rng(2).random((14, 14, 14)) < share).astype(float)
    field = np.clip(closed_random_field(7, 14), -1, 1)
    mesh = dual_contouring(volume_of(field, device, weight=weight))
    assert len(mesh.triangles) > 100
    assert is_manifold(mesh)
    assert self_intersections(mesh) == 0
    np.testing.assert_array_equal(np.unique(mesh.triangles), np.arange(len(mesh.vertices)))


def test_seen_cells_that_touch_in_an_edge_have_surfaces_of_their_own(device):
    field = (lattice(8)[..., 2] - 3.4) / 8
    weight = np.zeros(field.shape)
    weight[1:3, 1:3, 3:5], weight[2:4, 2:4, 3:5] = 1, 1
    mesh = dual_contouring(volume_of(field, device, weight=weight))
    # Two cells, each with a fan of four triangles about its middle.
    assert len(mesh.vertices) == 2 * 5
    assert len(mesh.triangles) == 2 * 4
    assert is_manifold(mesh)
    assert len(np.unique(mesh.vertices, axis=0)) == 2 * 5 - 1
    np.testing.assert_allclose(mesh.vertices[:, 2], 3.4, atol=1e-4)
    assert area(mesh) == pytest.approx(2, rel=1e-4)


def test_what_was_seen_of_a_ball_faces_outwards_with_colours_as_they_are_seen(device):
    solid = ball((0.01, -0.02, 0.03), 0.9)
    points, first_block = corners()
    color = 100 + 100 * points
    field = np.clip(solid(points.reshape(-1, 3)).reshape(points.shape[:3]), -1, 1)
    weight = (points[..., 0] + 0.3 * points[..., 1] < 0.2).astype(float)
    volume = volume_of(field, device, weight=weight, color=color, voxel_size=VOXEL_SIZE, first_block=first_block)
    mesh = dual_contouring(volume, normals=True)
    edges, uses = edge_uses(mesh)
    rim = np.unique(edges[uses == 1])
    assert len(rim) > 50
    outwards = mesh.vertices - np.array([0.01, -0.02, 0.03])
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    assert (np.einsum("ij,ij->i", outwards, mesh.normals) > 0.99).all()
    np.testing.assert_allclose(mesh.colors[rim], 100 + 100 * mesh.vertices[rim], atol=1)
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    # Slivers, where the surface all but meets a voxel, have no way that they face.
    large = np.linalg.norm(normals, axis=1) > 0.01 * VOXEL_SIZE**2
    assert large.mean() > 0.98
    assert (np.einsum("ij,ij->i", normals, a)[large] > 0).all()


def test_asked_of_an_oracle_edges_are_sharp_up_to_the_border(device):
    voxel_size = 0.04
    solid = cube(np.random.default_rng(4))
    points, _ = corners(voxel_size)
    volume = masked(solid, (points[..., 0] < 0.05).astype(float), device, voxel_size=voxel_size)
    errors = []
    for mesh in (dual_contouring(volume, oracle=solid.oracle(voxel_size, device)), marching_cubes(volume)):
        edges, uses = edge_uses(mesh)
        a, b = np.moveaxis(mesh.vertices.astype(float)[edges[uses == 1]], 1, 0)
        along = np.concatenate([a + share * (b - a) for share in np.linspace(0, 1, 11)])
        errors.append(np.abs(solid(along)).max() / voxel_size)
    assert 5 * errors[0] < errors[1], errors
