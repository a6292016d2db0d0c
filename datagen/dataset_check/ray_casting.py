"""Planar depth of a mesh along given rays, by Embree, made exact on the triangle that was hit."""

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from datagen.errors import InputError

try:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene
except ImportError:  # there is no wheel for every machine
    TriangleMesh = EmbreeScene = None


class MeshRays:
    """A triangle mesh, ready for rays: ``vertices`` (n, 3) in the world, metres, ``triangles`` (m, 3).

    Embree works in float32; the hit is intersected again with its triangle's plane in float64.
    """

    def __init__(self, vertices: NDArray[np.float64], triangles: NDArray[np.int64]) -> None:
        self._corners = np.asarray(vertices, np.float64)[triangles]
        self._normals = np.cross(self._corners[:, 1] - self._corners[:, 0], self._corners[:, 2] - self._corners[:, 0])
        self._scene = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, self._corners.astype(np.float32))

    def cast(
        self, origins: NDArray[np.float64], rays: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return for each ray (n, 3) from its origin (n, 3) the multiple of it that reaches the mesh, NaN for none.

        For rays with z = 1 in a camera's frame that is planar depth. The second result is the triangle, -1 for none.
        """
        result, triangles = np.full(len(rays), np.nan), np.full(len(rays), -1, np.int64)
        usable = np.flatnonzero(np.isfinite(rays).all(axis=1) & np.isfinite(origins).all(axis=1))
        if usable.size == 0:
            return result, triangles
        directions = rays[usable] / np.linalg.norm(rays[usable], axis=1, keepdims=True)
        triangle = self._scene.run(origins[usable].astype(np.float32), directions.astype(np.float32))
        hit = triangle >= 0
        usable, triangle = usable[hit], triangle[hit]
        normals = self._normals[triangle]
        facing = (normals * rays[usable]).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (normals * (self._corners[triangle, 0] - origins[usable])).sum(axis=1) / facing
        reach[~(np.isfinite(reach) & (reach > 0))] = np.nan
        result[usable], triangles[usable] = reach, triangle
        return result, triangles


def load_mesh_rays(path: Path) -> MeshRays | None:
    """Read a mesh file for ray casting; None where Embree is not to be had for this machine.

    Raises InputError where the file is missing, damaged or has no triangles.
    """
    if EmbreeScene is None:
        return None
    try:
        mesh = trimesh.load_mesh(path, process=False)
        vertices, triangles = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    except Exception as error:  # trimesh's readers raise whatever their parsing runs into
        raise InputError(f"{path}: cannot be read as a mesh ({error})") from error
    if len(triangles) == 0 or not np.isfinite(vertices).all():
        raise InputError(f"{path}: the mesh has no triangles, or vertices that are no numbers")
    return MeshRays(vertices, triangles)
