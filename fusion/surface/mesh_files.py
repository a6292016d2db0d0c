"""Reading and writing triangle meshes: PLY, OBJ, GLB and STL, and to read whatever else trimesh knows.

A glTF file (.glb, .gltf) has y up and linear vertex colours by its specification; both are converted here, once, so
that a mesh whose z is up stands upright in every viewer and comes back as it was.
"""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from datagen.atomic_write import write_bytes
from datagen.color import linear_from_srgb, srgb8_from_linear
from datagen.errors import InputError
from fusion.surface.mesh import Mesh

WRITABLE = {".ply": "", ".obj": "", ".glb": "", ".stl": "colours and normals"}
"""Formats by suffix, and what each of them has no place for."""

GLTF = (".glb", ".gltf")
GLTF_FROM_WORLD = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=np.float32)
"""World x right, y away, z up is glTF's x right, y up, z towards the viewer."""


def require_writable_format(path: Path) -> None:
    """Raise InputError unless ``path`` is named as a mesh format that can be written."""
    if path.suffix.lower() not in WRITABLE:
        raise InputError(f"{path}: meshes are written as {', '.join(WRITABLE)}; end the name in one of these")


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write a mesh atomically in the format of ``path``'s suffix, with the colours and normals that it can hold.

    Raises InputError for another suffix than those of ``WRITABLE``, and where the file cannot be written.
    """
    require_writable_format(path)
    write_bytes(path, _encode(mesh, path.suffix.lower()))


def read_mesh(path: Path) -> Mesh:
    """Read a triangle mesh of any format that trimesh knows; several objects in one file become one mesh.

    Normals are left where they are: a file's may be of any length and side.

    Raises InputError where the file is missing, damaged, or holds no triangles.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a triangle mesh")
    try:
        loaded: Any = trimesh.load(path, process=False)
    except Exception as error:  # trimesh's loaders raise whatever their parsing stumbles on
        raise InputError(f"{path}: cannot be read as a mesh ({type(error).__name__}: {error})") from error
    if isinstance(loaded, trimesh.Scene):
        loaded = loaded.to_geometry() if loaded.geometry else None
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0:
        raise InputError(f"{path}: holds no triangles; expected a triangle mesh, not a point cloud")
    vertices, faces = np.asarray(loaded.vertices), np.asarray(loaded.faces)
    if not np.isfinite(vertices).all():
        raise InputError(f"{path}: a vertex is NaN or infinite; repair the mesh")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path}: a triangle names a vertex that is not there; repair the mesh")
    colors = np.asarray(loaded.visual.vertex_colors[:, :3]) if loaded.visual.kind == "vertex" else None
    if path.suffix.lower() in GLTF:
        vertices = vertices @ GLTF_FROM_WORLD
        colors = None if colors is None else srgb8_from_linear(colors / 255)
    return Mesh(
        vertices=vertices.astype(np.float32),
        triangles=faces.astype(np.int32),
        colors=None if colors is None else colors.astype(np.uint8),
    )


def _encode(mesh: Mesh, suffix: str) -> bytes:
    if suffix == ".glb":
        return _encode_glb(mesh)
    has_normals = mesh.normals is not None
    exported = trimesh.Trimesh(
        mesh.vertices, mesh.triangles, vertex_colors=mesh.colors, vertex_normals=mesh.normals, process=False
    )
    if suffix == ".ply":
        return exported.export(file_type="ply", vertex_normal=has_normals)
    if suffix == ".obj":
        return exported.export(file_type="obj", include_normals=has_normals, include_texture=False).encode()
    return exported.export(file_type="stl")


def _encode_glb(mesh: Mesh) -> bytes:
    """Encode as binary glTF, colours in single precision: eight linear bits would band where it is dark."""
    normals = None if mesh.normals is None else mesh.normals @ GLTF_FROM_WORLD.T
    exported = trimesh.Trimesh(mesh.vertices @ GLTF_FROM_WORLD.T, mesh.triangles, vertex_normals=normals, process=False)
    if mesh.colors is not None:
        exported.vertex_attributes["_color"] = linear_from_srgb(mesh.colors / 255).astype(np.float32)

    def name_colors(tree: dict[str, Any]) -> None:
        for part in (part for entry in tree["meshes"] for part in entry["primitives"]):
            if "_color" in part["attributes"]:
                part["attributes"]["COLOR_0"] = part["attributes"].pop("_color")

    return exported.export(file_type="glb", include_normals=normals is not None, tree_postprocessor=name_colors)
