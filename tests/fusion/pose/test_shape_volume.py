import numpy as np
import pytest
import trimesh
from boxes import boxes
from three_balls import CENTRES, RADII, distances, sphere_points

from datagen.errors import InputError
from fusion.pose.pose_model import prepare_model
from fusion.pose.shape_volume import outward_normals, volume_from_mesh, volume_from_points
from fusion.surface.mesh import Mesh


def test_the_volume_of_a_mesh_has_its_surface_where_the_mesh_has(device):
    voxel, extents, centre = 0.004, np.array([0.2, 0.1, 0.15]), np.array([0.2, 0.05, 0.0])
    parts = trimesh.creation.box(extents), trimesh.creation.icosphere(5, 0.07).apply_translation(centre)
    shape = trimesh.util.concatenate(parts)
    mesh = Mesh(vertices=np.asarray(shape.vertices, np.float32), triangles=np.asarray(shape.faces, np.int32))

    def exact(points):
        beyond = np.abs(points) - extents / 2
        box = np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)
        return np.minimum(box, np.linalg.norm(points - centre, axis=1) - 0.07)

    model = prepare_model(volume_from_mesh(mesh, voxel_size=voxel, device=device))
    off = np.abs(exact(model.mesh.vertices.astype(float)))
    assert np.median(off) < 0.02 * voxel
    assert off.max() < voxel  # edges are rounded within a voxel
    # The same side is outside, near and far.
    points = np.random.default_rng(0).uniform((-0.15, -0.1, -0.1), (0.3, 0.15, 0.1), (4000, 3))
    found, _normals, sources = model.sample(points)
    told = (sources > 0) & (np.abs(exact(points)) > voxel)
    np.testing.assert_array_equal(found[told] < 0, exact(points)[told] < 0)


def test_the_volume_of_points_has_the_surface_that_they_were_drawn_from(device):
    points = sphere_points()
    model = prepare_model(volume_from_points(points, voxel_size=0.004, device=device))
    off = distances(model.mesh.vertices.astype(float))
    assert np.median(np.abs(off)) < 0.05 * 0.004
    assert np.quantile(np.abs(off), 0.95) < 0.004  # the rest is in the creases, which have no points
    assert model.diameter == pytest.approx(np.linalg.norm(np.ptp(points, axis=0)), rel=0.05)


def test_the_volume_of_points_ends_where_they_end(device):
    extents, spacing = np.array([0.1, 0.08, 0.06]), 0.003
    box = trimesh.creation.box(extents)
    count = int(box.area / spacing**2)
    points = np.asarray(trimesh.sample.sample_surface_even(box, 2 * count, seed=0)[0])
    model = prepare_model(volume_from_points(points, voxel_size=0.0015, device=device))
    # No plane goes on beyond an edge by more than the points are apart, of which some are a little farther.
    beyond = np.abs(model.mesh.vertices) - extents / 2
    assert beyond.max() < 1.5 * spacing
    # Nor is anything of the faces lost: their middles are covered to the points' spacing.
    for axis in range(3):
        for side in (-1, 1):
            on = np.abs(model.mesh.vertices[:, axis] - side * extents[axis] / 2) < 0.0015
            others = np.delete(model.mesh.vertices[on], axis, axis=1)
            assert (np.ptp(others, axis=0) > np.delete(extents, axis) - 2 * spacing).all()


def test_normals_of_points_face_outward():
    points = sphere_points()
    apart = np.linalg.norm(points[:, None] - CENTRES, axis=2) - RADII
    on = np.argmin(apart, axis=1)
    alone = np.sort(apart, axis=1)[:, 1] > 0.015  # not in the creases between two balls
    outward = (points - CENTRES[on]) / RADII[on][:, None]
    along = (outward_normals(points) * outward).sum(axis=1)
    assert along[alone].min() > 0.97


def test_what_has_no_surface_is_refused(device):
    with pytest.raises(InputError, match="3 points do not tell a surface"):
        volume_from_points(np.eye(3), voxel_size=0.01, device=device)
    empty = Mesh(vertices=boxes().vertices, triangles=np.zeros((0, 3), np.int32))
    with pytest.raises(InputError, match="no triangles"):
        volume_from_mesh(empty, voxel_size=0.01, device=device)
