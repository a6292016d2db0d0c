import json

import numpy as np
import pytest
import trimesh

from datagen.errors import InputError
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_files import read_mesh, write_mesh


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
    write_mesh(tmp_path / "mesh.ply", mesh)
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


def colored_sphere():
    shape = trimesh.creation.icosphere(subdivisions=2, radius=0.7)
    colors = np.random.default_rng(1).integers(0, 256, shape.vertices.shape).astype(np.uint8)
    return Mesh(
        vertices=np.asarray(shape.vertices, np.float32), triangles=np.asarray(shape.faces, np.int32), colors=colors
    )


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".stl"])
def test_a_mesh_comes_back_from_every_format_as_the_same_surface(tmp_path, suffix):
    mesh = colored_sphere()
    path = tmp_path / f"mesh{suffix}"
    write_mesh(path, mesh)
    read = read_mesh(path)
    # STL has triangles without shared vertices: the corners' places are what must agree.
    np.testing.assert_allclose(read.vertices[read.triangles], mesh.vertices[mesh.triangles], atol=1e-6)
    if suffix in (".ply", ".obj"):
        np.testing.assert_array_equal(read.colors, mesh.colors)


def test_gltf_colours_are_linear_light_and_y_is_up(tmp_path):
    # An independent reader: the file's own accessors, as the specification has them.
    mesh = colored_sphere()
    write_mesh(tmp_path / "mesh.glb", mesh)
    data = (tmp_path / "mesh.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    tree = json.loads(data[20 : 20 + length])
    binary = data[20 + length + 8 :]
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]

    def accessor(name):
        found = tree["accessors"][attributes[name]]
        assert (found["componentType"], found["type"]) == (5126, "VEC3")
        start = tree["bufferViews"][found["bufferView"]].get("byteOffset", 0) + found.get("byteOffset", 0)
        return np.frombuffer(binary, np.float32, 3 * found["count"], start).reshape(-1, 3)

    np.testing.assert_allclose(accessor("POSITION")[:, 1], mesh.vertices[:, 2], atol=1e-7)
    srgb = mesh.colors / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(accessor("COLOR_0"), linear, atol=1e-6)


def test_a_format_that_cannot_be_written_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(InputError, match=r"mesh\.fbx.*\.ply, \.obj, \.glb, \.stl"):
        write_mesh(tmp_path / "mesh.fbx", colored_sphere())
    assert not list(tmp_path.iterdir())
