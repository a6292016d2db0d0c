import numpy as np
import pytest
import trimesh

from fusion.surface.mesh import Mesh, read_mesh, write_ply


@pytest.mark.parametrize("with_colors", [False, True])
@pytest.mark.parametrize("with_normals", [False, True])
def test_a_mesh_comes_back_from_a_ply_file(tmp_path, with_colors, with_normals):
    shape = trimesh.creation.icosphere(subdivisions=2, radius=0.7)
    rng = np.random.default_rng(0)
    # Unlike those that the triangles would give.
    normals = rng.normal(size=shape.vertices.shape).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mesh = Mesh(
        vertices=np.asarray(shape.vertices, np.float32),
        triangles=np.asarray(shape.faces, np.int32),
        colors=rng.integers(0, 256, shape.vertices.shape).astype(np.uint8) if with_colors else None,
        normals=normals if with_normals else None,
    )
    write_ply(tmp_path / "mesh.ply", mesh)
    read = read_mesh(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(read.vertices, mesh.vertices)
    np.testing.assert_array_equal(read.triangles, mesh.triangles)
    assert (read.colors is None) == (mesh.colors is None)
    if with_colors:
        np.testing.assert_array_equal(read.colors, mesh.colors)
    assert read.normals is None
    assert (b"property float nx" in (tmp_path / "mesh.ply").read_bytes()) == with_normals
    if with_normals:
        stored = trimesh.load(tmp_path / "mesh.ply", process=False)
        np.testing.assert_allclose(stored.vertex_normals, normals, atol=1e-6)
