"""Triangle meshes with vertex colours and normals."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from datagen.atomic_write import write_bytes
from datagen.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """A triangle mesh in the world frame.

    ``vertices`` (n, 3) float32 metres; ``triangles`` (m, 3) int32, counter-clockwise seen from outside; ``colors``
    (n, 3) uint8 RGB, sRGB-encoded as in the images, or None; ``normals`` (n, 3) float32 of length 1, pointing outside,
    or None.
    """

    vertices: NDArray[np.float32]
    triangles: NDArray[np.int32]
    colors: NDArray[np.uint8] | None = None
    normals: NDArray[np.float32] | None = None


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write a mesh atomically as binary PLY, with the colours and normals that it has."""
    exported = trimesh.Trimesh(
        mesh.vertices, mesh.triangles, vertex_colors=mesh.colors, vertex_normals=mesh.normals, process=False
    )
    write_bytes(path, exported.export(file_type="ply", vertex_normal=mesh.normals is not None))


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
    colors = loaded.visual.vertex_colors[:, :3] if loaded.visual.kind == "vertex" else None
    return Mesh(
        vertices=vertices.astype(np.float32),
        triangles=faces.astype(np.int32),
        colors=None if colors is None else np.asarray(colors, dtype=np.uint8),
    )
