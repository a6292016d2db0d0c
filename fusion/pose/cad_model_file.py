"""CAD models as files: meshes of any format that trimesh knows, or the points of a surface.

Apart from what is done with a model, as trimesh is slow to import and a reconstruction is located in without it.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from datagen.errors import InputError
from fusion.pose.cad_model import CadModel
from fusion.surface.mesh_files import read_mesh


def read_cad_model(path: Path, *, scale: float = 1.0) -> CadModel:
    """Read a mesh, or points of a surface (.xyz, .ply without faces), times ``scale`` metres a unit of the file.

    Raises InputError where it is missing, damaged or empty, and for a scale that is not positive.
    """
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"--model-scale {scale:g}: expected a positive number, metres a unit of the model's file")
    points = _points_alone(path)
    if points is not None:
        return CadModel(source=str(path), mesh=None, points=_measured(path, points * scale))
    mesh = read_mesh(path)
    mesh = replace(mesh, vertices=(mesh.vertices * np.float32(scale)))
    texture, uv = _texture(path, len(mesh.vertices))
    used = mesh.vertices[np.unique(mesh.triangles)].astype(np.float64)
    return CadModel(source=str(path), mesh=mesh, points=_measured(path, used), texture=texture, uv=uv)


def _measured(path: Path, points: NDArray[np.float64]) -> NDArray[np.float64]:
    if not np.linalg.norm(np.ptp(points, axis=0)) > 0:
        raise InputError(f"{path}: all of the model's points are one; give a model that has an extent")
    return points


def _points_alone(path: Path) -> NDArray[np.float64] | None:
    """Return the points (n, 3) of a file that holds no triangles, None for a mesh."""
    if path.suffix.lower() not in (".xyz", ".ply") or not path.is_file():
        return None
    try:
        loaded: Any = trimesh.load(path, process=False)
    except Exception as error:  # trimesh's loaders raise whatever their parsing stumbles on
        raise InputError(f"{path}: cannot be read as a model ({type(error).__name__}: {error})") from error
    if not isinstance(loaded, trimesh.PointCloud) or not len(loaded.vertices):
        return None
    points = np.asarray(loaded.vertices, np.float64)
    if not np.isfinite(points).all():
        raise InputError(f"{path}: a point is NaN or infinite; repair the file")
    return points


def _texture(path: Path, vertices: int) -> tuple[NDArray[np.uint8] | None, NDArray[np.float64] | None]:
    """Return the texture of a mesh file and its vertices' places in it, None for both where it has none."""
    loaded: Any = trimesh.load(path, process=False)
    if isinstance(loaded, trimesh.Scene):
        loaded = loaded.to_geometry()
    visual = loaded.visual
    uv = getattr(visual, "uv", None)
    material = getattr(visual, "material", None)
    picture = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    if visual.kind != "texture" or uv is None or picture is None or len(uv) != vertices:
        return None, None
    return np.asarray(picture.convert("RGB"), np.uint8), np.asarray(uv, np.float64)
