import itertools

import numpy as np
import pytest
import skimage.measure
import trimesh
import warp as wp
from scipy.spatial import KDTree

from fusion.marching_cubes import marching_cubes
from fusion.volume import Volume


def volume_of(field, device, *, weight=None, color=None, voxel_size=1.0):
    """Put a dense field (nx, ny, nz) into a volume, voxel (0, 0, 0) at the world's origin; padding is unseen."""
    blocks = [-(-side // 8) for side in field.shape]
    padding = [(0, 8 * n - side) for n, side in zip(blocks, field.shape, strict=True)]
    weight = np.pad(np.ones(field.shape) if weight is None else weight, padding)
    color = np.pad(np.zeros((*field.shape, 3)) if color is None else color, [*padding, (0, 0)])

    def tile(array):
        """Into (blocks, 512): blocks in x, y, z order; within one z slowest, x fastest."""
        parts = array.reshape(blocks[0], 8, blocks[1], 8, blocks[2], 8, -1).transpose(0, 2, 4, 5, 3, 1, 6)
        return parts.reshape(-1, array.shape[3]) if array.ndim == 4 else parts.reshape(-1)

    volume = Volume(voxel_size=voxel_size, truncation=1.0, device=device, max_blocks=10**5)
    volume.table.adopt(np.array(list(itertools.product(*map(range, blocks))), np.int32))
    volume.reserve(volume.table.count)
    assert volume.reserved == volume.table.count
    tiled_weight = tile(weight)
    sums = {
        "distance_sum": tile(np.pad(field, padding)) * tiled_weight,
        "weight": tiled_weight,
        "color_sum": tile(color) * tiled_weight[:, None],
        "color_weight": tiled_weight,
    }
    for name, values in sums.items():
        array = volume.arrays()[name]
        wp.copy(array, wp.array(values.astype(np.float32), dtype=array.dtype, device=device))
    return volume


def as_trimesh(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)


def lattice(size):
    return np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), -1).astype(float)


def closed_random_field(seed, size=20):
    """Noise of both signs, positive all around: its surface must be closed."""
    field = np.random.default_rng(seed).normal(size=(size,) * 3)
    field[[0, -1]], field[:, [0, -1]], field[:, :, [0, -1]] = 1, 1, 1
    return field


@pytest.mark.parametrize("seed", range(10))
def test_a_closed_random_field_gives_a_closed_manifold(device, seed):
    # White noise has every one of the 256 cases and every ambiguous face.
    mesh = as_trimesh(marching_cubes(volume_of(closed_random_field(seed), device)))
    edges = np.sort(mesh.edges, axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    assert set(uses) == {2}
    assert mesh.is_winding_consistent
    # Around each vertex its triangles form one fan: as many faces as neighbours, all in one piece.
    assert mesh.is_watertight


def test_normals_point_out_of_the_negative_side(device):
    field = np.linalg.norm(lattice(24) - 11.6, axis=-1) - 7.3
    mesh = as_trimesh(marching_cubes(volume_of(field, device, voxel_size=0.5)))
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * (7.3 * 0.5) ** 3, rel=0.02)
    assert mesh.center_mass == pytest.approx([5.8] * 3, abs=0.01)


def test_it_agrees_with_scikit_image_on_a_smooth_field(device):
    # No face of this field is ambiguous at this resolution, so that any correct table gives the same vertices.
    x, y, z = np.moveaxis(lattice(33) / 32 * 2 * np.pi, -1, 0)
    field = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x) + 0.05
    mesh = marching_cubes(volume_of(field, device))
    expected, faces, _, _ = skimage.measure.marching_cubes(field.astype(np.float32), 0.0)
    ours, theirs = (np.unique(np.round(vertices, 3), axis=0) for vertices in (mesh.vertices, expected))
    assert len(mesh.vertices) == len(ours)
    distance, _ = KDTree(theirs).query(ours)
    assert distance.max() < 2e-3
    assert abs(len(ours) - len(theirs)) <= 0.001 * len(theirs)
    assert as_trimesh(mesh).area == pytest.approx(skimage.measure.mesh_surface_area(expected, faces), rel=2e-3)


def test_vertices_converge_with_the_square_of_the_voxel_size(device):
    # A torus under a smooth warp: its curvature varies, and no lattice plane is one of symmetry.
    def field(points):
        x, y, z = np.moveaxis(points, -1, 0)
        x = x + 0.1 * np.sin(3 * y)
        return (np.sqrt(x**2 + y**2) - 0.55) ** 2 + (z + 0.07 * x) ** 2 - 0.25**2

    errors = []
    for size in (24, 48, 96):
        voxel_size = 2 / (size - 1)
        mesh = marching_cubes(volume_of(field(lattice(size) * voxel_size - 1), device, voxel_size=voxel_size))
        points = mesh.vertices.astype(float) - 1
        step = 1e-5
        gradient = np.stack(
            [(field(points + step * axis) - field(points - step * axis)) / (2 * step) for axis in np.eye(3)], -1
        )
        errors.append(np.sqrt(np.mean((field(points) / np.linalg.norm(gradient, axis=-1)) ** 2)))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders >= 1.9).all(), orders


def test_unobserved_voxels_never_make_surface(device):
    # The field changes sign at x = 9.5 everywhere, but half of it was never seen.
    field = lattice(20)[..., 0] - 9.5
    weight = (lattice(20)[..., 1] < 10).astype(float)
    mesh = marching_cubes(volume_of(field, device, weight=weight))
    assert len(mesh.triangles) > 0
    assert mesh.vertices[:, 1].max() <= 9
    assert len(marching_cubes(volume_of(field, device, weight=np.zeros((20, 20, 20)))).triangles) == 0


def test_there_are_no_cracks_between_blocks(device):
    # The plane crosses several blocks: its only boundary is the rim of what was observed.
    size = 30
    field = lattice(size) @ np.array([0.31, 0.22, 0.93]) - 21.7
    mesh = as_trimesh(marching_cubes(volume_of(field, device)))
    edges, uses = np.unique(np.sort(mesh.edges, axis=1), axis=0, return_counts=True)
    rim = mesh.vertices[edges[uses == 1]]
    on_the_border = (np.abs(rim) < 1e-5) | (np.abs(rim - (size - 1)) < 1e-5)
    assert on_the_border.any(axis=(1, 2)).all()
    assert mesh.body_count == 1


def test_colours_are_interpolated_along_edges(device):
    points = lattice(16)
    color = np.stack([points[..., 0] * 10, points[..., 1] * 5, 100 + points[..., 2]], -1)
    mesh = marching_cubes(volume_of(points @ np.array([0.6, 0.5, 0.4]) - 11.3, device, color=color))
    x, y, z = mesh.vertices.T
    np.testing.assert_allclose(mesh.colors, np.stack([10 * x, 5 * y, 100 + z], -1), atol=0.51)


def test_an_empty_volume_gives_an_empty_mesh(device):
    mesh = marching_cubes(Volume(voxel_size=0.1, truncation=0.3, device=device, max_blocks=10))
    assert mesh.vertices.shape == (0, 3)
    assert mesh.triangles.shape == (0, 3)
