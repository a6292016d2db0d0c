"""Meshes of single blocks, to be replaced as their blocks change, and the one mesh that they make together.

A piece is complete by itself: it holds all vertices of its block's cells, also those that belong to a block beyond and
that the pieces there hold too. Each vertex lies on one edge of the voxel lattice, by whose number the copies are found
and welded; so vertices that only happen to meet in a point stay apart, as they do in the mesh of the whole volume.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from fusion.surface.cells import block_numbers, blocks_around
from fusion.surface.layers import NONE, Cells, launch_over_layers, lowest_bit, number_of
from fusion.surface.marching_cubes import Surface, extract_surface, mesh_of
from fusion.surface.mesh import Mesh
from fusion.volume.block_table import BLOCK_SIDE, BLOCK_VOXELS
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_BLOCK_EDGES = wp.constant(wp.int64(3 * BLOCK_VOXELS))
_LAYER_EDGES = wp.constant(3 * BLOCK_SIDE**2)


@dataclass(frozen=True, kw_only=True)
class MeshPiece:
    """A part of a volume's mesh; ``edges`` (n,) int64 are the numbers of its vertices' lattice edges.

    The edge along ``axis`` from voxel (x, y, z) of block b has number 1536·b + 192·z + 64·axis + 8·y + x.
    """

    mesh: Mesh
    edges: NDArray[np.int64]


@wp.kernel
def _list_edges(first: int, cells: Cells, edges: wp.array(dtype=wp.int64)) -> None:
    layer = wp.tid() + first
    vertex = cells.starts[layer][0]
    if vertex == cells.starts[layer + 1][0]:
        return
    base = wp.int64(number_of(cells, layer >> 3)) * _BLOCK_EDGES + wp.int64((layer & 7) * _LAYER_EDGES)
    for axis in range(3):
        left = cells.edges[layer, axis]
        while left != NONE:
            edges[vertex] = base + wp.int64(64 * axis + lowest_bit(left))
            vertex += 1
            left = left & (left - wp.uint64(1))


def mesh_piece(volume: Volume, blocks: ArrayLike, *, min_weight: float = 0.0, normals: bool = False) -> MeshPiece:
    """Return the mesh of the cells of some blocks as one piece; the options are those of ``marching_cubes``."""
    return _piece_of(volume, extract_surface(volume, min_weight=min_weight, normals=normals, blocks=blocks))


def mesh_each(
    volume: Volume, blocks: ArrayLike, *, min_weight: float = 0.0, normals: bool = False
) -> dict[int, MeshPiece]:
    """Return the pieces of some blocks by block number, ascending; those without a surface are left out."""
    numbers = block_numbers(volume, blocks)
    surface = extract_surface(volume, min_weight=min_weight, normals=normals, blocks=numbers, apart=True)
    together = _piece_of(volume, surface)
    firsts = surface.cells.starts.numpy()[:: 8 * BLOCK_SIDE]  # a block has a group of eight slots
    pieces = {}
    for i in np.flatnonzero(np.diff(firsts[:, 1])).tolist():
        (vertex, triangle), (vertex_end, triangle_end) = firsts[i].tolist(), firsts[i + 1].tolist()
        pieces[int(numbers[i])] = _cut(together, slice(vertex, vertex_end), slice(triangle, triangle_end))
    return pieces


def weld(pieces: Iterable[MeshPiece]) -> Mesh:
    """Join pieces of one volume, made with the same options from different blocks, so that they share vertices.

    Vertices ascend by lattice edge, triangles follow each other as the pieces do: the pieces of all blocks, in the
    order of the blocks' numbers, give exactly the mesh of the whole volume.
    """
    parts = list(pieces)
    if not parts:
        return _EMPTY
    edges = np.concatenate([part.edges for part in parts])
    _, kept, vertex_of = np.unique(edges, return_index=True, return_inverse=True)
    sizes = np.array([len(part.edges) for part in parts])
    firsts = np.repeat(np.cumsum(sizes) - sizes, [len(part.mesh.triangles) for part in parts])
    corners = np.concatenate([part.mesh.triangles for part in parts]) + firsts[:, None]
    colors = [part.mesh.colors for part in parts if part.mesh.colors is not None]
    normals = [part.mesh.normals for part in parts if part.mesh.normals is not None]
    return Mesh(
        vertices=np.concatenate([part.mesh.vertices for part in parts])[kept],
        triangles=vertex_of.astype(np.int32)[corners],
        colors=np.concatenate(colors)[kept] if colors else None,
        normals=np.concatenate(normals)[kept] if normals else None,
    )


class MeshPieces:
    """The pieces of a volume that changes, by block number; ``mesh`` is always that of the whole volume.

    ``min_weight`` and ``normals`` are those of ``marching_cubes``.
    """

    def __init__(self, *, min_weight: float = 0.0, normals: bool = False) -> None:
        self.min_weight = min_weight
        self.normals = normals
        self.pieces: dict[int, MeshPiece] = {}

    def update(self, volume: Volume, changed: ArrayLike) -> NDArray[np.int32]:
        """Mesh anew what depends on ``changed``, the numbers of all blocks that changed or are new since the last time.

        Returns the numbers of the blocks whose pieces were replaced or dropped: the changed ones and those one before,
        whose cells reach into them; with normals all around, since these take the field one voxel farther on each side.
        """
        steps = range(-1, 2) if self.normals else range(-1, 1)
        stale = blocks_around(volume.table, block_numbers(volume, changed), steps=steps)
        fresh = mesh_each(volume, stale, min_weight=self.min_weight, normals=self.normals)
        for number in stale.tolist():
            self.pieces.pop(number, None)
        self.pieces.update(fresh)
        return stale

    def mesh(self) -> Mesh:
        """Return the welded mesh, equal to that of ``marching_cubes`` for the whole volume."""
        return weld(self.pieces[number] for number in sorted(self.pieces))


_EMPTY = Mesh(
    vertices=np.zeros((0, 3), np.float32), triangles=np.zeros((0, 3), np.int32), colors=np.zeros((0, 3), np.uint8)
)


def _piece_of(volume: Volume, surface: Surface) -> MeshPiece:
    edges = wp.empty(len(surface.vertices), dtype=wp.int64, device=volume.device)
    layers = len(surface.cells.starts) - 1
    launch_over_layers(_list_edges, dim=layers, inputs=[surface.cells], outputs=[edges], device=volume.device)
    return MeshPiece(mesh=mesh_of(surface), edges=edges.numpy())


def _cut(piece: MeshPiece, vertices: slice, triangles: slice) -> MeshPiece:
    """Return a copy of some vertices and the triangles between them: a view would keep the whole piece alive."""
    mesh = piece.mesh
    return MeshPiece(
        mesh=Mesh(
            vertices=mesh.vertices[vertices].copy(),
            triangles=mesh.triangles[triangles] - np.int32(vertices.start),
            colors=None if mesh.colors is None else mesh.colors[vertices].copy(),
            normals=None if mesh.normals is None else mesh.normals[vertices].copy(),
        ),
        edges=piece.edges[vertices].copy(),
    )
