import numpy as np
import pytest
from dense_volume import lattice, volume_of

from fusion.surface.marching_cubes import marching_cubes


@pytest.fixture(params=["packed", "full"])
def storage(request):
    return request.param


def test_a_planes_normals_are_its_own(device, storage):
    # Over 4 × 4 × 4 blocks and up to the rim, where the differences are one-sided: a plane's are exact all the same.
    normal = np.array([0.48, -0.6, 0.64])
    field = ((lattice(30) - 14.3) @ normal) / 27
    volume = volume_of(field, device, storage=storage, voxel_size=0.02, first_block=(-2, -1, -3))
    normals = marching_cubes(volume, normals=True).normals
    # A packed distance is off by half a step of 1/32767: over two steps 3e-5 of the gradient's 2/27, along each axis.
    atol = 1e-3 if storage == "packed" else 1e-5
    np.testing.assert_allclose(normals, np.broadcast_to(normal, normals.shape), atol=atol)


def test_a_spheres_normals_point_from_its_centre(device, storage):
    # Central differences and the interpolation between them are off by the square of the voxel over the radius.
    centre, radius = np.array([15.3, 16.1, 15.8]), 11.2
    field = np.clip((np.linalg.norm(lattice(32) - centre, axis=-1) - radius) / 5, -1, 1)
    mesh = marching_cubes(volume_of(field, device, storage=storage), normals=True)
    expected = mesh.vertices - centre
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)
    assert np.degrees(np.arccos(np.clip((mesh.normals * expected).sum(1), -1, 1))).max() < 0.2


def test_normals_do_not_see_the_borders_of_blocks(device, storage):
    # The same field moved by a voxel at a time lies differently on the blocks; its normals stay.
    def normals(shift):
        points = lattice(30) - 10 - shift
        field = np.clip((np.linalg.norm(points * [1, 1.3, 0.8], axis=-1) - 7.3) / 5, -1, 1)
        mesh = marching_cubes(volume_of(field, device, storage=storage), normals=True)
        vertices = np.round(mesh.vertices - shift, 3)
        return mesh.normals[np.lexsort(vertices.T)]

    first = normals(0)
    for shift in (1, 3, 7):
        np.testing.assert_allclose(normals(shift), first, atol=1e-5 if storage == "full" else 1e-3)


def test_unseen_voxels_have_no_part_in_normals(device, storage):
    # One layer of cells was seen, and the field beyond it is nonsense: the differences are one-sided there.
    field = (lattice(12) @ np.array([0.6, 0.0, 0.8]) - 6.3) / 12
    x = lattice(12)[..., 0]
    seen = ((x >= 4) & (x <= 5)).astype(float)
    weight = 1.0 + seen
    volume = volume_of(np.where(seen > 0, field, 0.9), device, storage=storage, weight=weight)
    normals = marching_cubes(volume, min_weight=1.0, normals=True).normals
    assert len(normals) > 0
    atol = 2e-3 if storage == "packed" else 1e-5
    np.testing.assert_allclose(normals, np.broadcast_to([0.6, 0, 0.8], normals.shape), atol=atol)


def test_a_field_without_slope_still_has_unit_normals(device):
    # Alternating layers: every central difference is 0, and only the edges tell where outside is.
    z = lattice(8)[..., 2]
    normals = marching_cubes(volume_of(np.where(z % 2 == 0, 1.0, -1.0), device), normals=True).normals
    np.testing.assert_array_equal(np.abs(normals), np.broadcast_to([0.0, 0.0, 1.0], normals.shape))


def test_normals_are_made_only_when_asked_for(device):
    volume = volume_of(lattice(8)[..., 0] - 3.5, device)
    assert marching_cubes(volume).normals is None
    assert marching_cubes(volume, normals=True).normals.dtype == np.float32
