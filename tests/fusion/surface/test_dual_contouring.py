import numpy as np
import pytest
from analytic_oracle import ball, cube, l_shape, random_solid
from dense_volume import closed_random_field, lattice, volume_of
from mesh_topology import edge_uses, enclosed_volume, is_closed, is_manifold, self_intersections

from fusion.evaluation.evaluate import sample_surface
from fusion.surface.closest_points import closest_points
from fusion.surface.dual_contouring.dual_contouring import dual_contouring
from fusion.surface.dual_contouring.vertices import VertexRoom
from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.mesh import Mesh


@pytest.fixture(params=["packed", "full"])
def storage(request):
    return request.param


def assert_all_used(mesh):
    np.testing.assert_array_equal(np.unique(mesh.triangles), np.arange(len(mesh.vertices)))


@pytest.mark.parametrize("seed", range(6))
def test_a_closed_random_field_gives_a_closed_manifold_that_never_meets_itself(device, storage, seed):
    # White noise has every one of the 256 cases, beside every other.
    field = closed_random_field(seed, 14)
    mesh = dual_contouring(volume_of(np.clip(field, -1, 1), device, storage=storage))
    assert is_closed(mesh)
    assert is_manifold(mesh)
    assert self_intersections(mesh) == 0
    assert_all_used(mesh)


@pytest.mark.parametrize("seed", range(12))
def test_random_solids_give_closed_manifolds_that_never_meet_themselves(device, seed):
    voxel_size = 0.07
    solid = random_solid(np.random.default_rng(seed))
    volume = solid.volume(voxel_size, device)
    for oracle in (None, solid.oracle(voxel_size, device)):
        mesh = dual_contouring(volume, oracle=oracle)
        assert is_closed(mesh)
        assert is_manifold(mesh)
        assert self_intersections(mesh) == 0
        assert_all_used(mesh)


def test_unseen_voxels_at_random_leave_a_manifold_with_a_border(device, storage):
    # Each vertex touches the border once at most, though cells lose any of their edges.
    rng = np.random.default_rng(2)
    weight = (rng.random((14, 14, 14)) < 0.97).astype(float)
    field = np.clip(closed_random_field(7, 14), -1, 1)
    mesh = dual_contouring(volume_of(field, device, storage=storage, weight=weight))
    assert len(mesh.triangles) > 100
    assert is_manifold(mesh)
    assert not is_closed(mesh)
    assert_all_used(mesh)


def test_there_is_a_quad_around_each_edge_with_four_seen_cells_and_a_triangle_for_each_around_others(device, storage):
    rng = np.random.default_rng(3)
    shape = (19, 13, 11)
    # A plane, so that no quad is a fan: twice as many triangles as quads.
    field = (lattice(19)[:, :13, :11] @ np.array([0.31, 0.22, 0.93]) - 9.3) / 30
    weight = (rng.random(shape) < 0.95).astype(float)
    volume = volume_of(field, device, storage=storage, weight=weight, first_block=(-2, -1, -3))
    seen = np.ones([n - 1 for n in shape], bool)
    for c in range(8):
        seen &= weight[tuple(slice(c >> a & 1, n - 1 + (c >> a & 1)) for a, n in enumerate(shape))] > 0
    padded = np.pad(seen, 1)
    quads, others = 0, 0
    for axis in range(3):
        inside = field < 0
        crossed = np.diff(inside.astype(int), axis=axis) != 0
        around = np.zeros(crossed.shape, int)
        for b in (0, 1):
            for c in (0, 1):
                shift = [1, 1, 1]
                shift[(axis + 1) % 3], shift[(axis + 2) % 3] = b, c
                around += padded[tuple(slice(s, s + n) for s, n in zip(shift, crossed.shape, strict=True))]
        quads += (crossed & (around == 4)).sum()
        others += around[crossed & (around < 4)].sum()
    mesh = dual_contouring(volume)
    assert quads > 50
    assert others > 50
    assert len(mesh.triangles) == 2 * quads + others
    unseen = volume_of(field, device, storage=storage, weight=np.zeros(shape))
    assert len(dual_contouring(unseen).triangles) == 0


def test_a_plane_is_met_exactly_without_cracks_between_blocks(device, storage):
    size, normal = 30, np.array([0.31, 0.22, 0.93])
    field = (lattice(size) @ normal - 21.7) / 25
    mesh = dual_contouring(volume_of(field, device, storage=storage), normals=True)
    away = np.abs(mesh.vertices @ normal - 21.7) / np.linalg.norm(normal)
    assert away.max() < 2e-3  # packed distances are in steps of 1/32767, of 25 voxels
    np.testing.assert_allclose(mesh.normals @ normal / np.linalg.norm(normal), 1, atol=1e-3)
    edges, uses = edge_uses(mesh)
    rim = mesh.vertices[edges[uses == 1]]
    on_the_border = (rim < 1) | (rim > size - 2)
    assert on_the_border.any(axis=2).all()


@pytest.mark.parametrize("blocks_away", [0, 100, 4000])
def test_however_far_from_the_origin_nothing_meets_itself_though_coordinates_are_rounded(device, blocks_away):
    # Of values of all sizes, so that the surface crowds around voxels.
    sizes = 10 ** np.random.default_rng(4).uniform(-6, 0, (14, 14, 14))
    field = np.clip(sizes * closed_random_field(3, 14), -1, 1)
    volume = volume_of(field, device, first_block=(blocks_away, -blocks_away, blocks_away), voxel_size=0.013)
    mesh = dual_contouring(volume)
    assert is_manifold(mesh)
    assert self_intersections(mesh) == 0


def test_a_plane_in_a_plane_of_the_lattice_is_met_as_closely_as_packed_voxels_tell(device):
    field = np.broadcast_to((np.arange(20) - 9.0) / 4, (20, 20, 20))
    mesh = dual_contouring(volume_of(np.clip(field, -1, 1), device, storage="packed", voxel_size=1.0))
    assert np.abs(mesh.vertices[:, 2] - 9).max() < 4 / 32767


def test_a_sphere_faces_outwards_and_has_its_volume(device, storage):
    field = np.linalg.norm(lattice(24) - 11.6, axis=-1) - 7.3
    volume = volume_of(np.clip(field / 5, -1, 1), device, storage=storage, voxel_size=0.5)
    mesh = dual_contouring(volume, normals=True)
    assert enclosed_volume(mesh) == pytest.approx(4 / 3 * np.pi * (7.3 * 0.5) ** 3, rel=0.02)
    outwards = mesh.vertices - 5.8
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    assert (np.einsum("ij,ij->i", outwards, mesh.normals) > 0.99).all()


def torus(points):
    """Warped, so that its curvature varies and no lattice plane is one of symmetry."""
    x, y, z = np.moveaxis(points, -1, 0)
    x = x + 0.1 * np.sin(3 * y)
    return (np.sqrt(x**2 + y**2) - 0.55) ** 2 + (z + 0.07 * x) ** 2 - 0.25**2


def errors_of(mesh_of, device):
    """Return the rms distance of vertices from the torus at three voxel sizes, halved each time."""
    errors = []
    for size in (24, 48, 96):
        voxel_size = 2 / (size - 1)
        stored = np.clip(4 * torus(lattice(size) * voxel_size - 1), -1, 1)
        points = mesh_of(volume_of(stored, device, voxel_size=voxel_size)).vertices.astype(float) - 1
        step = 1e-5
        slopes = [(torus(points + step * axis) - torus(points - step * axis)) / (2 * step) for axis in np.eye(3)]
        errors.append(np.sqrt(np.mean((torus(points) / np.linalg.norm(np.stack(slopes, -1), axis=-1)) ** 2)))
    return np.array(errors)


def test_vertices_converge_with_the_square_of_the_voxel_size(device):
    errors = errors_of(dual_contouring, device)
    orders = np.log2(errors[:-1] / errors[1:])
    assert (orders >= 1.9).all(), orders


def sharp_error(mesh, solid, creases, voxel_size):
    """Return the mean distance from the surface of the mesh's points within half a voxel of an edge, in voxels."""
    points = sample_surface(mesh, 100_000, rng=np.random.default_rng(0)).points
    near = creases(points) < 0.5 * voxel_size
    assert near.sum() > 500
    return np.abs(solid(points[near])).mean() / voxel_size


def cube_creases(solid):
    """Return a function of the distance from a cube's edges."""

    def distance(points):
        q = (points - solid.centres[0]) @ solid.rotations[0]
        return np.linalg.norm(np.sort(np.abs(np.abs(q) - solid.halves[0]), axis=1)[:, :2], axis=1)

    return distance


@pytest.mark.parametrize("seed", range(4))
def test_a_cubes_edges_are_five_times_sharper_than_those_of_marching_cubes(device, seed):
    voxel_size = 0.04
    solid = cube(np.random.default_rng(seed))
    volume = solid.volume(voxel_size, device)
    sharp = dual_contouring(volume, oracle=solid.oracle(voxel_size, device))
    creases = cube_creases(solid)
    errors = [sharp_error(mesh, solid, creases, voxel_size) for mesh in (sharp, marching_cubes(volume))]
    assert 5 * errors[0] < errors[1], errors


@pytest.mark.parametrize("seed", range(2))
def test_asked_of_the_volume_alone_a_cubes_edges_are_no_rounder_than_those_of_marching_cubes(device, seed):
    voxel_size = 0.04
    solid = cube(np.random.default_rng(seed))
    volume = solid.volume(voxel_size, device)
    creases = cube_creases(solid)
    errors = [
        sharp_error(mesh, solid, creases, voxel_size) for mesh in (dual_contouring(volume), marching_cubes(volume))
    ]
    assert errors[0] < errors[1], errors


def test_concave_edges_are_sharp_too(device):
    voxel_size = 0.04
    solid = l_shape(np.random.default_rng(1))
    volume = solid.volume(voxel_size, device)
    sharp = dual_contouring(volume, oracle=solid.oracle(voxel_size, device))
    # The inner edge, where the corner was cut out.
    ends = solid.centres[1] + np.array([[-0.31, -0.31, z] for z in (-0.15, 0.15)]) @ solid.rotations[0].T
    inner = ends[0] + np.linspace(0, 1, 200)[:, None] * (ends[1] - ends[0])
    away = [closest_points(mesh, inner, device=device).distances.mean() for mesh in (sharp, marching_cubes(volume))]
    assert 5 * away[0] < away[1], np.array(away) / voxel_size


def test_a_smooth_surface_is_no_worse_than_that_of_marching_cubes(device):
    voxel_size = 0.05
    solid = ball(np.array([0.013, -0.02, 0.031]), 0.5)
    volume = solid.volume(voxel_size, device)

    def error(mesh):
        return np.abs(solid(sample_surface(mesh, 100_000, rng=np.random.default_rng(0)).points)).mean() / voxel_size

    cubes = error(marching_cubes(volume))
    assert error(dual_contouring(volume, oracle=solid.oracle(voxel_size, device))) < 0.5 * cubes
    assert error(dual_contouring(volume)) < cubes


def test_the_oracle_says_which_voxels_are_inside(device):
    # The volume is a cube whose faces were moved outwards by most of a voxel; the oracle knows where they are.
    voxel_size = 0.05
    solid = cube(np.random.default_rng(5))
    bulged = solid.__class__(solid.kinds, solid.ways, solid.centres, solid.halves + 0.9 * voxel_size, solid.rotations)
    mesh = dual_contouring(bulged.volume(voxel_size, device), oracle=solid.oracle(voxel_size, device))
    expected = dual_contouring(solid.volume(voxel_size, device), oracle=solid.oracle(voxel_size, device))
    assert is_closed(mesh)
    assert closest_points(expected, mesh.vertices, device=device).distances.mean() < 0.01 * voxel_size
    assert enclosed_volume(mesh) == pytest.approx(8 * 0.31**3, rel=5e-3)


def test_colours_are_those_of_the_voxels_around(device, storage):
    points = lattice(16)
    color = np.stack([points[..., 0] * 10, points[..., 1] * 5, 100 + points[..., 2]], -1)
    field = (points @ np.array([0.6, 0.5, 0.4]) - 11.3) / 16
    mesh = dual_contouring(volume_of(field, device, storage=storage, color=color))
    x, y, z = mesh.vertices.T
    # The average over the cell's crossings, which lie within the same plane's part of the cell.
    np.testing.assert_allclose(mesh.colors, np.stack([10 * x, 5 * y, 100 + z], -1), atol=3)


def test_the_mesh_is_the_same_each_time_and_for_each_division_of_the_work(device, monkeypatch):
    volume = volume_of(np.clip(closed_random_field(5, 24), -1, 1), device, storage="packed")
    meshes = [dual_contouring(volume, normals=True)]
    for shares in (1, 8):
        monkeypatch.setattr("fusion.surface.dual_contouring.cell_points.shares_on", lambda _, shares=shares: shares)
        meshes.append(dual_contouring(volume, normals=True))
    for mesh in meshes[1:]:
        for name in ("vertices", "triangles", "colors", "normals"):
            np.testing.assert_array_equal(getattr(meshes[0], name), getattr(mesh, name))


@pytest.mark.parametrize("min_weight", [0.0, 1.0, 2.9, 4.0])
def test_voxels_of_little_weight_count_as_unseen(device, storage, min_weight):
    weight = np.random.default_rng(0).integers(0, 8, (20, 20, 20)).astype(float)
    weight[:, 10:] += 4
    field = closed_random_field(1) / 4
    masked = np.where(weight > min_weight, weight, 0)
    mesh = dual_contouring(volume_of(field, device, storage=storage, weight=weight), min_weight=min_weight)
    expected = dual_contouring(volume_of(field, device, storage=storage, weight=masked))
    assert len(mesh.triangles) > 0
    np.testing.assert_array_equal(mesh.vertices, expected.vertices)
    np.testing.assert_array_equal(mesh.triangles, expected.triangles)


def test_the_tests_of_topology_tell_what_is_wrong():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    across = np.array([[0.5, 0.2, -1], [0.5, 0.2, 1], [0.5, 0.9, 0.5]], np.float32)
    crossing = Mesh(vertices=np.concatenate([square, across]), triangles=np.int32([[0, 1, 2], [0, 2, 3], [4, 5, 6]]))
    assert self_intersections(crossing) > 0
    assert is_manifold(crossing)
    bow_tie = Mesh(vertices=np.zeros((5, 3), np.float32), triangles=np.int32([[0, 1, 2], [0, 3, 4]]))
    assert not is_manifold(bow_tie)
    fin = Mesh(vertices=np.zeros((5, 3), np.float32), triangles=np.int32([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    assert not is_manifold(fin)


@pytest.mark.parametrize("expected", [0, 3, 4, 9])
def test_vertices_follow_each_other_whatever_room_there_is(device, expected):
    values = np.arange(15, dtype=np.float32).reshape(5, 3)
    room = VertexRoom(expected, device, normals=True)
    for some in (slice(0, 3), slice(3, 3), slice(3, 5)):
        part = room.take(some.stop - some.start)
        part.points.assign(values[some])
        part.colors.assign(values[some].astype(np.uint8))
        part.normals.assign(-values[some])
    np.testing.assert_array_equal(room.taken("points"), values)
    np.testing.assert_array_equal(room.taken("colors"), values)
    np.testing.assert_array_equal(room.taken("normals"), -values)
