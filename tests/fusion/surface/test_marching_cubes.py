import numpy as np
import pytest
import skimage.measure
import trimesh
from dense_volume import closed_random_field, lattice, volume_of
from scipy.spatial import KDTree

from datagen.errors import InputError
from fusion.surface.marching_cubes import extract_surface, marching_cubes
from fusion.surface.marching_cubes_table import CORNERS, EDGE_CORNERS, triangle_table
from fusion.surface.mesh_pieces import mesh_piece
from fusion.volume.tsdf_volume import Volume


@pytest.fixture(params=["packed", "full"])
def storage(request):
    return request.param


def as_trimesh(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)


@pytest.mark.parametrize("seed", range(10))
def test_a_closed_random_field_gives_a_closed_manifold(device, storage, seed):
    # White noise has every one of the 256 cases and every ambiguous face.
    mesh = as_trimesh(marching_cubes(volume_of(closed_random_field(seed), device, storage=storage)))
    edges = np.sort(mesh.edges, axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    assert set(uses) == {2}
    assert mesh.is_winding_consistent
    # Around each vertex its triangles form one fan: as many faces as neighbours, all in one piece.
    assert mesh.is_watertight


def test_triangles_face_out_of_the_negative_side(device, storage):
    field = np.linalg.norm(lattice(24) - 11.6, axis=-1) - 7.3
    mesh = as_trimesh(marching_cubes(volume_of(field / 5, device, storage=storage, voxel_size=0.5)))
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * (7.3 * 0.5) ** 3, rel=0.02)
    assert mesh.center_mass == pytest.approx([5.8] * 3, abs=0.01)


def test_it_agrees_with_scikit_image_on_a_smooth_field(device, storage):
    # No face of this field is ambiguous at this resolution, so that any correct table gives the same vertices.
    x, y, z = np.moveaxis(lattice(33) / 32 * 2 * np.pi, -1, 0)
    field = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x) + 0.05
    # Steps of 1/32767 in the packed voxels are 4e-4 voxels where the field rises least along an edge.
    mesh = marching_cubes(volume_of(field / 4, device, storage=storage))
    expected, faces, _, _ = skimage.measure.marching_cubes(field.astype(np.float32), 0.0)
    ours, theirs = (np.unique(np.round(vertices, 3), axis=0) for vertices in (mesh.vertices, expected))
    assert len(mesh.vertices) == len(ours)
    distance, _ = KDTree(theirs).query(ours)
    assert distance.max() < 2e-3
    assert abs(len(ours) - len(theirs)) <= 0.001 * len(theirs)
    assert as_trimesh(mesh).area == pytest.approx(skimage.measure.mesh_surface_area(expected, faces), rel=2e-3)


def test_vertices_converge_with_the_square_of_the_voxel_size(device, storage):
    # A torus under a smooth warp: its curvature varies, and no lattice plane is one of symmetry.
    def field(points):
        x, y, z = np.moveaxis(points, -1, 0)
        x = x + 0.1 * np.sin(3 * y)
        return (np.sqrt(x**2 + y**2) - 0.55) ** 2 + (z + 0.07 * x) ** 2 - 0.25**2

    errors = []
    for size in (24, 48, 96):
        voxel_size = 2 / (size - 1)
        # Packed, a field cut off at a quarter, far from the surface: its steps are 8e-6, its error at least 1e-4.
        stored = np.clip(4 * field(lattice(size) * voxel_size - 1), -1, 1)
        mesh = marching_cubes(volume_of(stored, device, storage=storage, voxel_size=voxel_size))
        points = mesh.vertices.astype(float) - 1
        step = 1e-5
        gradient = np.stack(
            [(field(points + step * axis) - field(points - step * axis)) / (2 * step) for axis in np.eye(3)], -1
        )
        errors.append(np.sqrt(np.mean((field(points) / np.linalg.norm(gradient, axis=-1)) ** 2)))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders >= 1.9).all(), orders


def test_unobserved_voxels_never_make_surface(device, storage):
    # The field changes sign at x = 9.5 everywhere, but half of it was never seen.
    field = lattice(20)[..., 0] - 9.5
    weight = (lattice(20)[..., 1] < 10).astype(float)
    mesh = marching_cubes(volume_of(field / 20, device, storage=storage, weight=weight))
    assert len(mesh.triangles) == 2 * 9 * 19
    assert mesh.vertices[:, 1].max() == 9
    unseen = volume_of(field, device, storage=storage, weight=np.zeros((20, 20, 20)))
    assert len(marching_cubes(unseen).triangles) == 0


@pytest.mark.parametrize("min_weight", [0.0, 0.5, 1.0, 2.9, 3.0, 7.0])
def test_voxels_of_little_weight_count_as_unseen(device, storage, min_weight):
    weight = np.random.default_rng(0).integers(0, 8, (20, 20, 20)).astype(float)
    weight[:, 10:] += 4
    field = closed_random_field(1) / 4
    masked = np.where(weight > min_weight, weight, 0)
    mesh = marching_cubes(volume_of(field, device, storage=storage, weight=weight), min_weight=min_weight)
    expected = marching_cubes(volume_of(field, device, storage=storage, weight=masked))
    assert len(mesh.triangles) > 0
    np.testing.assert_array_equal(mesh.vertices, expected.vertices)
    np.testing.assert_array_equal(mesh.triangles, expected.triangles)


def test_the_cells_are_those_with_eight_seen_corners_and_both_signs(device, storage):
    # Against a dense count, one corner at a time: holes and signs at random, at block borders too.
    rng = np.random.default_rng(3)
    field, weight = rng.normal(size=(27, 19, 22)), (rng.random((27, 19, 22)) < 0.9).astype(float)
    volume = volume_of(np.clip(field, -1, 1), device, storage=storage, weight=weight, first_block=(-2, -1, -3))
    corners = [
        tuple(slice(c >> axis & 1, side - 1 + (c >> axis & 1)) for axis, side in enumerate(field.shape))
        for c in range(8)
    ]
    seen = np.all([weight[corner] > 0 for corner in corners], axis=0)
    case = sum((field[corner] < 0).astype(int) << c for c, corner in enumerate(corners))
    counts, edges = triangle_table()
    assert len(marching_cubes(volume).triangles) == counts[case[seen]].sum()
    used = {
        (axis, *(np.array(cell) + CORNERS[low]).tolist())
        for cell in np.argwhere(seen)
        for edge in edges[case[tuple(cell)]]
        if edge >= 0
        for axis, low in [(edge // 4, EDGE_CORNERS[edge, 0])]
    }
    # The blocks are numbered with x slowest.
    edges = mesh_piece(volume, range(volume.table.count)).edges
    number, place = edges // 1536, edges % 1536
    corner = 8 * np.stack([number // 9, number // 3 % 3, number % 3], -1)
    voxel = corner + np.stack([place % 8, place // 8 % 8, place // 192], -1)
    assert {(axis, *point) for axis, point in zip((place % 192 // 64).tolist(), voxel.tolist(), strict=True)} == used
    assert len(edges) == len(used) == len(marching_cubes(volume).vertices)


def test_the_mesh_is_the_same_each_time(device, storage):
    volume = volume_of(closed_random_field(5, size=40), device, storage=storage)
    one, two = marching_cubes(volume, normals=True), marching_cubes(volume, normals=True)
    for name in ("vertices", "triangles", "colors", "normals"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_the_mesh_does_not_depend_on_how_a_layer_is_divided_among_threads(device, storage, monkeypatch):
    volume = volume_of(closed_random_field(6), device, storage=storage)
    meshes = []
    for shares in (1, 8):
        for module in ("fusion.surface.marching_cubes", "fusion.surface.vertex_normals"):
            monkeypatch.setattr(f"{module}.shares_on", lambda _, shares=shares: shares)
        meshes.append(marching_cubes(volume, normals=True))
    for name in ("vertices", "triangles", "colors", "normals"):
        np.testing.assert_array_equal(getattr(meshes[0], name), getattr(meshes[1], name))


def test_vertices_are_unique_and_all_used(device, storage):
    surface = extract_surface(volume_of(closed_random_field(2), device, storage=storage))
    triangles = surface.triangles.numpy()
    np.testing.assert_array_equal(np.unique(triangles), np.arange(len(surface.vertices)))


def test_there_are_no_cracks_between_blocks(device, storage):
    # The plane crosses several blocks: its only boundary is the rim of what was observed.
    size = 30
    field = lattice(size) @ np.array([0.31, 0.22, 0.93]) - 21.7
    mesh = as_trimesh(marching_cubes(volume_of(field / 25, device, storage=storage)))
    edges, uses = np.unique(np.sort(mesh.edges, axis=1), axis=0, return_counts=True)
    rim = mesh.vertices[edges[uses == 1]]
    on_the_border = (np.abs(rim) < 1e-5) | (np.abs(rim - (size - 1)) < 1e-5)
    assert on_the_border.any(axis=(1, 2)).all()
    assert mesh.body_count == 1


def test_colours_are_interpolated_along_edges(device, storage):
    points = lattice(16)
    color = np.stack([points[..., 0] * 10, points[..., 1] * 5, 100 + points[..., 2]], -1)
    field = (points @ np.array([0.6, 0.5, 0.4]) - 11.3) / 16
    mesh = marching_cubes(volume_of(field, device, storage=storage, color=color))
    x, y, z = mesh.vertices.T
    # Whole levels are packed as they are.
    np.testing.assert_allclose(mesh.colors, np.stack([10 * x, 5 * y, 100 + z], -1), atol=0.51)


def test_a_voxel_without_colour_is_left_out(device, storage):
    # The plane lies between x = 3 and x = 4; colour is known at x = 3 for small y, at x = 4 for large z.
    x, y, z = np.moveaxis(lattice(8), -1, 0)
    known = np.where(x == 3, y < 4, z > 3).astype(float)
    color = np.where(x[..., None] == 3, [200.0, 10, 0], [100.0, 30, 255])
    volume = volume_of((x - 3.25) / 8, device, storage=storage, color=color, color_weight=known)
    mesh = marching_cubes(volume)
    _, y, z = mesh.vertices.round().astype(int).T
    expected = np.zeros((64, 3))
    expected[(y < 4) & (z <= 3)] = [200, 10, 0]
    expected[(y >= 4) & (z > 3)] = [100, 30, 255]
    expected[(y < 4) & (z > 3)] = [175, 15, 63.75]
    np.testing.assert_allclose(mesh.colors, expected, atol=0.51)


def test_an_empty_volume_gives_an_empty_mesh(device):
    mesh = marching_cubes(Volume(voxel_size=0.1, truncation=0.3, device=device, max_blocks=10))
    assert mesh.vertices.shape == (0, 3)
    assert mesh.triangles.shape == (0, 3)
    assert mesh.colors.shape == (0, 3)


def test_no_blocks_give_an_empty_mesh_and_unknown_ones_an_error(device):
    volume = volume_of(closed_random_field(0), device)
    assert len(marching_cubes(volume, blocks=[]).vertices) == 0
    with pytest.raises(InputError, match="27 blocks"):
        marching_cubes(volume, blocks=[3, 27])
