"""Meshes of a volume while it grows, small enough to be looked at as they come."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_files import write_mesh
from fusion.volume.tsdf_volume import Volume

MOST_TRIANGLES = 100_000
"""A viewer that draws while frames arrive has no time for more."""


class Snapshots:
    """Writes the mesh of what is fused so far to ``path``, about ``count`` times, each in the place of the last one."""

    def __init__(self, path: Path, *, count: int, most_triangles: int = MOST_TRIANGLES) -> None:
        self._path = path
        self._count = count
        self._most_triangles = most_triangles
        self._written = 0

    def __call__(self, volume: Volume, done: int, total: int) -> None:
        """Take note that ``done`` of ``total`` frames are in the volume, and write a mesh where it is time for one."""
        due = done * self._count // total
        if due <= self._written:
            return
        self._written = due
        mesh = marching_cubes(volume)
        if len(mesh.triangles):
            write_mesh(self._path, thinned(mesh, self._most_triangles, cell=volume.voxel_size))


def thinned(mesh: Mesh, most_triangles: int, *, cell: float) -> Mesh:
    """Return the mesh, or where it has too many triangles, one whose vertices in a cell of a grid are made one.

    Cells of a mesh extracted at voxels of ``cell`` metres are made larger until few enough triangles are left: at cells
    n times as wide a surface has about n² times fewer.
    """
    thin, factor = mesh, 1.0
    while len(thin.triangles) > most_triangles:
        factor *= max(1.2, (len(thin.triangles) / most_triangles) ** 0.5)
        thin = _merged_in_cells(mesh, factor * cell)
    return thin


def _merged_in_cells(mesh: Mesh, cell: float) -> Mesh:
    places = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / cell).astype(np.int64)
    numbers = np.ravel_multi_index(tuple(places.T), tuple(places.max(axis=0) + 1))
    unique, labels = np.unique(numbers, return_inverse=True)
    count = len(unique)
    triangles = labels[mesh.triangles]
    a, b, c = triangles.T
    kept = triangles[(a != b) & (b != c) & (c != a)]
    colors = None if mesh.colors is None else np.rint(_means(mesh.colors, labels, count)).astype(np.uint8)
    return Mesh(
        vertices=_means(mesh.vertices, labels, count).astype(np.float32),
        triangles=kept.astype(np.int32),
        colors=colors,
    )


def _means(values: NDArray, labels: NDArray[np.int64], count: int) -> NDArray[np.float64]:
    sizes = np.bincount(labels, minlength=count)
    return np.column_stack([np.bincount(labels, column, count) / sizes for column in values.T])
