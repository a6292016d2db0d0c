import numpy as np
import pytest
import trimesh

from datagen.dataset_check.ray_casting import MeshRays, load_mesh_rays
from datagen.errors import InputError


def test_rays_meet_a_tilted_plane_where_its_equation_says():
    rng = np.random.default_rng(0)
    normal = np.array([0.3, -0.2, -1.0])
    corners = np.array([[-9, -9], [9, -9], [9, 9], [-9, 9.0]])
    heights = (normal[:2] * corners).sum(axis=1) + 3  # the plane z = 3 + 0.3 x − 0.2 y
    rays = MeshRays(np.column_stack([corners, heights]), np.array([[0, 1, 2], [0, 2, 3]]))
    directions = np.column_stack([rng.uniform(-0.5, 0.5, (500, 2)), np.ones(500)])
    origins = rng.uniform(-0.3, 0.3, (500, 3))
    reach, triangle = rays.cast(origins, directions)
    expected = (3 + origins[:, :2] @ normal[:2] - origins[:, 2]) / (1 - directions[:, :2] @ normal[:2])
    assert (triangle >= 0).all()
    np.testing.assert_allclose(reach, expected, rtol=1e-13)


def test_rays_that_miss_have_no_depth():
    sphere = trimesh.creation.icosphere()
    rays = MeshRays(sphere.vertices, sphere.faces)
    origins, directions = np.tile([0.0, 0, -3], (3, 1)), np.array([[0, 0, 1.0], [5, 0, 1], [0, 0, -1]])
    reach, triangle = rays.cast(origins, directions)
    assert reach[0] == pytest.approx(2, abs=0.02)
    assert np.isnan(reach[1:]).all()
    assert (triangle[1:] == -1).all()


def test_a_file_that_is_no_mesh_is_refused(tmp_path):
    path = tmp_path / "mesh.ply"
    path.write_text("nothing")
    with pytest.raises(InputError, match=r"mesh\.ply"):
        load_mesh_rays(path)
