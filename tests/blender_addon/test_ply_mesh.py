from pathlib import Path

import numpy as np
import pytest
import trimesh

from blender_addon.errors import ReconstructionError
from blender_addon.files.ply_mesh import read_colored_mesh


@pytest.fixture
def sphere() -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    generator = np.random.default_rng(0)
    mesh.visual.vertex_colors = generator.integers(0, 256, (len(mesh.vertices), 4), dtype=np.uint8)
    return mesh


def test_a_mesh_written_by_trimesh_is_read_whole(tmp_path: Path, sphere: trimesh.Trimesh) -> None:
    sphere.export(tmp_path / "mesh.ply")
    mesh = read_colored_mesh(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(mesh.vertices_world, sphere.vertices.astype(np.float32))
    np.testing.assert_array_equal(mesh.triangles, sphere.faces)
    np.testing.assert_array_equal(mesh.colors_srgb, sphere.visual.vertex_colors)


def test_normals_beside_the_coordinates_are_passed_over(tmp_path: Path, sphere: trimesh.Trimesh) -> None:
    sphere.export(tmp_path / "mesh.ply", vertex_normal=True)
    mesh = read_colored_mesh(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(mesh.vertices_world, sphere.vertices.astype(np.float32))
    np.testing.assert_array_equal(mesh.colors_srgb, sphere.visual.vertex_colors)


def test_triangles_that_name_a_vertex_twice_are_left_out(tmp_path: Path) -> None:
    _write(tmp_path / "mesh.ply", triangles=[(0, 1, 2), (0, 0, 1), (2, 1, 2)])
    assert read_colored_mesh(tmp_path / "mesh.ply").triangles.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize("bytes_kept", [0, 2, 60, 400, 2000])
def test_a_file_cut_anywhere_is_refused(tmp_path: Path, sphere: trimesh.Trimesh, bytes_kept: int) -> None:
    path = tmp_path / "mesh.ply"
    path.write_bytes(sphere.export(file_type="ply")[:bytes_kept])
    with pytest.raises(ReconstructionError, match=r"mesh\.ply: (not a whole PLY file|cut short).*fusion reconstruct"):
        read_colored_mesh(path)


def test_a_file_without_its_last_byte_is_refused(tmp_path: Path, sphere: trimesh.Trimesh) -> None:
    path = tmp_path / "mesh.ply"
    path.write_bytes(sphere.export(file_type="ply")[:-1])
    with pytest.raises(ReconstructionError, match="cut short"):
        read_colored_mesh(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ReconstructionError, match=r"mesh\.ply: the file is missing"):
        read_colored_mesh(tmp_path / "mesh.ply")


def test_a_text_ply_is_refused(tmp_path: Path, sphere: trimesh.Trimesh) -> None:
    sphere.export(tmp_path / "mesh.ply", encoding="ascii")
    with pytest.raises(ReconstructionError, match="format is ascii, expected binary_little_endian"):
        read_colored_mesh(tmp_path / "mesh.ply")


def test_a_mesh_without_colours_is_refused(tmp_path: Path) -> None:
    trimesh.creation.box().export(tmp_path / "mesh.ply")
    with pytest.raises(ReconstructionError, match="no colours"):
        read_colored_mesh(tmp_path / "mesh.ply")


@pytest.mark.parametrize("index", [3, -1])
def test_an_index_that_no_vertex_has_is_refused(tmp_path: Path, index: int) -> None:
    _write(tmp_path / "mesh.ply", triangles=[(0, 1, index)])
    with pytest.raises(ReconstructionError, match=f"names vertex {index}, there are 3"):
        read_colored_mesh(tmp_path / "mesh.ply")


def test_a_vertex_at_nan_is_refused(tmp_path: Path) -> None:
    _write(tmp_path / "mesh.ply", triangles=[(0, 1, 2)], last_x=float("nan"))
    with pytest.raises(ReconstructionError, match=r"vertex 2 is at \[nan"):
        read_colored_mesh(tmp_path / "mesh.ply")


def test_a_mesh_without_triangles_is_refused(tmp_path: Path) -> None:
    _write(tmp_path / "mesh.ply", triangles=[])
    with pytest.raises(ReconstructionError, match="holds 3 vertices and 0 triangles"):
        read_colored_mesh(tmp_path / "mesh.ply")


def test_quadrilaterals_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    _write(path, triangles=[(0, 1, 2)])
    data = bytearray(path.read_bytes())
    data[-13] = 4
    path.write_bytes(bytes(data) + bytes(4))
    with pytest.raises(ReconstructionError, match="not triangles"):
        read_colored_mesh(path)


def _write(path: Path, *, triangles: list[tuple[int, int, int]], last_x: float = 0.0) -> None:
    header = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 3\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
        f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    vertices = np.zeros(3, np.dtype([("position", "<f4", 3), ("color", "u1", 3)]))
    vertices["position"] = [(0, 0, 0), (1, 0, 0), (last_x, 1, 0)]
    faces = np.zeros(len(triangles), np.dtype([("size", "u1"), ("indices", "<i4", 3)]))
    faces["size"] = 3
    if triangles:
        faces["indices"] = triangles
    path.write_bytes(header.encode() + vertices.tobytes() + faces.tobytes())
