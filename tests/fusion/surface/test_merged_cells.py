"""Dual contouring that merges cells where the surface is flat."""

import numpy as np
import pytest
from analytic_oracle import ball, cube, random_solid
from dense_volume import closed_random_field, lattice, volume_of
from mesh_topology import edge_uses, is_closed, is_manifold, self_intersections

from fusion.evaluation.evaluate import sample_surface
from fusion.surface.closest_points import closest_points
from fusion.surface.dual_contouring.cell_merging.box_quads import cut_quads_of_boxes
from fusion.surface.dual_contouring.dual_contouring import dual_contouring
from fusion.surface.dual_contouring.snap_signs import MOST_SNAP, snapped
from fusion.surface.marching_cubes import marching_cubes

FLATNESS = 0.05


@pytest.fixture(params=["packed", "full"])
def storage(request):
    return request.param


def smooth_noise(seed, size, *, rounds=1, steepness=1):
    """Return a closed field of noise (size,)³ that was smoothed, so that some of its surface is flat."""
    field = closed_random_field(seed, size)
    for axis in rounds * [0, 1, 2]:
        field = (field + np.roll(field, 1, axis) + np.roll(field, -1, axis)) / 3
    field[[0, -1]], field[:, [0, -1]], field[:, :, [0, -1]] = 1, 1, 1
    return np.clip(steepness * field, -1, 1)


@pytest.mark.parametrize("flatness", [0.02, 0.3])
@pytest.mark.parametrize("seed", range(6))
def test_random_solids_stay_closed_manifolds_that_never_meet_themselves(device, seed, flatness):
    voxel_size = 0.05
    solid = random_solid(np.random.default_rng(seed))
    volume = solid.volume(voxel_size, device)
    for oracle in (None, solid.oracle(voxel_size, device)):
        mesh = dual_contouring(volume, oracle=oracle, flatness=flatness)
        assert is_closed(mesh)
        assert is_manifold(mesh)
        assert self_intersections(mesh) == 0
        np.testing.assert_array_equal(np.unique(mesh.triangles), np.arange(len(mesh.vertices)))
        assert len(mesh.vertices) < len(dual_contouring(volume, oracle=oracle).vertices)


@pytest.mark.parametrize("seed", range(3))
def test_noise_stays_a_closed_manifold_that_never_meets_itself(device, storage, seed):
    mesh = dual_contouring(volume_of(smooth_noise(seed, 24), device, storage=storage), flatness=0.2)
    assert is_closed(mesh)
    assert is_manifold(mesh)
    assert self_intersections(mesh) == 0


@pytest.mark.parametrize("seed", [3, 11])
def test_the_mesh_is_within_the_flatness_of_that_of_cells_and_this_of_it(device, seed):
    voxel_size = 0.03
    solid = random_solid(np.random.default_rng(seed))
    volume = solid.volume(voxel_size, device)
    cells = dual_contouring(volume)
    dense = sample_surface(cells, 20_000, rng=np.random.default_rng(0)).points
    for flatness in (0.05, 0.2):
        mesh = dual_contouring(volume, flatness=flatness)
        points = sample_surface(mesh, 20_000, rng=np.random.default_rng(0)).points
        away = [
            closest_points(*pair, device=device).distances / voxel_size for pair in ((mesh, dense), (cells, points))
        ]
        # Checked is at vertices and middles; where signs snap, sharp edges of cells move by more.
        assert np.quantile(away, 0.99) < flatness


@pytest.mark.parametrize("seed", [7, 45])
def test_every_triangle_is_near_to_the_mesh_of_cells_and_each_vertex_of_cells_to_it(device, seed):
    # In noise 45 a triangle beside a box, between cells alone, is what is farthest off.
    flatness, snap = 0.1, MOST_SNAP
    volume = volume_of(smooth_noise(seed, 32, rounds=2, steepness=3), device)
    cells = dual_contouring(snapped(volume, min_weight=0, within=snap))
    mesh = dual_contouring(volume, flatness=flatness)
    corners = mesh.vertices[mesh.triangles]
    samples = [corners, (corners + np.roll(corners, 1, axis=1)) / 2, corners.mean(axis=1)]
    samples = np.concatenate([some.reshape(-1, 3) for some in samples])
    for some, points in ((cells, samples), (mesh, cells.vertices)):
        # A coordinate of some tens has 4e-6 in float32.
        assert closest_points(some, points, device=device).distances.max() < flatness - snap + 1e-5
    assert len(mesh.vertices) < len(cells.vertices)


@pytest.mark.parametrize("flatness", [0.05, 0.2])
def test_asked_of_an_oracle_it_is_off_by_no_more_than_cells_are_and_the_flatness(device, flatness):
    voxel_size = 0.03
    solid = random_solid(np.random.default_rng(11))
    volume, oracle = solid.volume(voxel_size, device), solid.oracle(voxel_size, device)
    meshes = [dual_contouring(volume, oracle=oracle, flatness=some) for some in (0, flatness)]
    cells, merged = (
        np.abs(solid(sample_surface(mesh, 50_000, rng=np.random.default_rng(0)).points)) / voxel_size for mesh in meshes
    )
    assert np.quantile(merged, 0.999) < np.quantile(cells, 0.999) + flatness
    assert len(meshes[1].vertices) < 0.6 * len(meshes[0].vertices)


def test_a_smooth_surface_is_off_by_no_more_than_the_flatness(device):
    voxel_size = 0.02
    solid = ball((0.013, -0.02, 0.031), 0.5)
    volume = solid.volume(voxel_size, device)
    counts = [len(dual_contouring(volume).vertices)]
    for flatness in (0.02, 0.05, 0.2):
        mesh = dual_contouring(volume, flatness=flatness)
        points = sample_surface(mesh, 20_000, rng=np.random.default_rng(0)).points
        assert np.abs(solid(points)).max() < (flatness + 0.02) * voxel_size
        counts.append(len(mesh.vertices))
    assert (np.diff(counts) < 0).all()
    assert counts[-1] < counts[0] / 5


def test_a_plane_has_one_vertex_a_block_but_near_the_border(device, storage):
    size = 8 * 6
    field = np.broadcast_to(np.clip(np.arange(size) - 20.3, -1, 1), (size,) * 3)
    mesh = dual_contouring(volume_of(field, device, storage=storage), flatness=FLATNESS)
    inner = ((mesh.vertices[:, :2] > 8) & (mesh.vertices[:, :2] < size - 8)).all(axis=1)
    assert inner.sum() == 4 * 4
    np.testing.assert_allclose(mesh.vertices[:, 2], 20.3, atol=2e-3)
    assert is_manifold(mesh)
    assert self_intersections(mesh) == 0


def test_noise_about_a_plane_of_the_lattice_leaves_one_vertex_a_block(device, storage):
    # The surface wanders between the cells on both sides of the plane, so that twice as many have vertices.
    size = 8 * 5
    noise = np.random.default_rng(0).normal(scale=1e-3, size=(size,) * 3)
    field = np.clip(np.arange(size) - 16 + noise, -1, 1)
    weight = np.broadcast_to((np.arange(size) >= 12).astype(float), field.shape)  # no farther than the truncation
    volume = volume_of(field, device, storage=storage, weight=weight)
    counts = []
    for flatness in (0, FLATNESS):
        mesh = dual_contouring(volume, flatness=flatness)
        counts.append((((mesh.vertices[:, :2] > 8) & (mesh.vertices[:, :2] < size - 8)).all(axis=1)).sum())
        assert np.abs(mesh.vertices[:, 2] - 16).max() < 0.02
    assert counts[0] > 1.2 * (size - 16) ** 2
    assert counts[1] == 3 * 3


def test_sharp_edges_stay(device):
    voxel_size = 0.03
    solid = cube(np.random.default_rng(1))
    volume = solid.volume(voxel_size, device)
    merged = dual_contouring(volume, oracle=solid.oracle(voxel_size, device), flatness=FLATNESS)
    corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T * solid.halves[0]
    ends = [(a, b) for a in corners for b in corners if (a != b).sum() == 1]
    along = np.linspace(0.05, 0.95, 40)[:, None]
    edges = np.concatenate([(1 - along) * a + along * b for a, b in ends]) @ solid.rotations[0].T + solid.centres[0]
    away = [closest_points(mesh, edges, device=device).distances.mean() for mesh in (merged, marching_cubes(volume))]
    assert 5 * away[0] < away[1], np.array(away) / voxel_size
    assert len(merged.vertices) < 0.5 * len(marching_cubes(volume).vertices)


def test_the_border_stays_as_it_is(device, storage):
    rng = np.random.default_rng(3)
    size = 40
    field = np.clip(lattice(size) @ np.array([0.31, 0.22, 0.92]) - 25.3, -1, 1)
    weight = (rng.random((size,) * 3) < 0.9995).astype(float)
    volume = volume_of(field, device, storage=storage, weight=weight)
    borders = []
    for flatness in (0, FLATNESS):
        mesh = dual_contouring(volume, flatness=flatness)
        assert is_manifold(mesh)
        assert self_intersections(mesh) == 0
        edges, uses = edge_uses(mesh)
        borders.append(np.unique(mesh.vertices[edges[uses == 1]].reshape(-1, 6), axis=0))
    assert len(mesh.vertices) < 0.7 * len(dual_contouring(volume).vertices)
    ours, theirs = (np.unique(border.reshape(-1, 3), axis=0) for border in borders)
    np.testing.assert_array_equal(ours, theirs)


def test_colours_and_normals_are_those_around(device, storage):
    points = lattice(32)
    color = np.stack([points[..., 0] * 6, points[..., 1] * 5, 100 + points[..., 2]], -1)
    normal = np.array([0.1, 0.2, 0.97])
    field = np.clip((points @ normal - 20.3) / 4, -1, 1)
    volume = volume_of(field, device, storage=storage, color=color, voxel_size=0.25)
    mesh = dual_contouring(volume, normals=True, flatness=FLATNESS)
    x, y, z = mesh.vertices.T / 0.25
    np.testing.assert_allclose(mesh.colors, np.stack([6 * x, 5 * y, 100 + z], -1), atol=4)
    np.testing.assert_allclose(mesh.normals @ normal / np.linalg.norm(normal), 1, atol=2e-3)
    assert dual_contouring(volume, flatness=FLATNESS).normals is None


def test_the_mesh_is_the_same_each_time(device):
    solid = random_solid(np.random.default_rng(2))
    volume = solid.volume(0.04, device)
    first, second = (dual_contouring(volume, normals=True, flatness=FLATNESS) for _ in range(2))
    for name in ("vertices", "triangles", "colors", "normals"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_nothing_makes_nothing(device):
    unseen = volume_of(np.ones((9, 9, 9)), device, weight=np.zeros((9, 9, 9)))
    for volume in (unseen, volume_of(np.ones((9, 9, 9)), device)):
        assert len(dual_contouring(volume, flatness=FLATNESS).triangles) == 0


def test_what_is_all_border_stays_as_it_is(device):
    field = np.broadcast_to(np.arange(6) - 2.4, (6,) * 3)
    weight = np.zeros((6,) * 3)
    weight[2:4, 2:4] = 1
    volume = volume_of(np.clip(field, -1, 1), device, weight=weight)
    cells, mesh = (dual_contouring(volume, flatness=flatness) for flatness in (0, FLATNESS))
    assert len(cells.triangles) == 4
    np.testing.assert_array_equal(mesh.vertices, cells.vertices)
    np.testing.assert_array_equal(mesh.triangles, cells.triangles)


def test_boxes_that_do_not_see_each_other_make_meshes_meet_themselves(device, monkeypatch):
    # What the tests above count is there where no box is split.
    monkeypatch.setattr(
        "fusion.surface.dual_contouring.cell_merging.merge_cells.BoxFlatness.refuse_far", lambda *_: False
    )
    monkeypatch.setattr("fusion.surface.dual_contouring.cell_merging.merge_cells.cut_quads_of_boxes", cut_and_forget)
    volumes = [random_solid(np.random.default_rng(seed)).volume(0.05, device) for seed in range(4)]
    assert sum(self_intersections(dual_contouring(volume, flatness=0.3)) for volume in volumes) > 0


def cut_and_forget(grid, along, corners, boxes, cell_splits, splits):
    cut_quads_of_boxes(grid, along, corners, boxes, cell_splits, splits)
    boxes.refused.zero_()
