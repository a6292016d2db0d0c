"""A mesh as the arrays that Blender keeps, made where no interface waits for them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .ply_mesh import ColoredMesh


@dataclass(frozen=True, kw_only=True)
class MeshArrays:
    """What a triangle mesh is to Blender.

    ``positions`` (3N) float32; ``corner_verts`` (3M) int32; ``edge_verts`` (2E) int32, each edge once, and
    ``corner_edges`` (3M) int32, the edge from each corner to the next; ``colors`` (4N) float32 RGBA, sRGB, 0 to 1.
    """

    positions: NDArray[np.float32]
    corner_verts: NDArray[np.int32]
    edge_verts: NDArray[np.int32]
    corner_edges: NDArray[np.int32]
    colors: NDArray[np.float32]


def mesh_arrays(mesh: ColoredMesh) -> MeshArrays:
    """Return the arrays of a mesh; finding the edges sorts all corners, a second and more for a million vertices."""
    first = mesh.triangles.ravel().astype(np.int64)
    second = np.roll(mesh.triangles, -1, axis=1).ravel().astype(np.int64)
    count = len(mesh.vertices_world)
    keys = np.minimum(first, second) * count + np.maximum(first, second)
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    is_new = np.concatenate([[True], ordered[1:] != ordered[:-1]])
    edges = ordered[is_new]
    corner_edges = np.empty(len(keys), np.int32)
    corner_edges[order] = np.cumsum(is_new) - 1
    return MeshArrays(
        positions=np.ascontiguousarray(mesh.vertices_world).ravel(),
        corner_verts=np.ascontiguousarray(mesh.triangles).ravel(),
        edge_verts=np.column_stack([edges // count, edges % count]).astype(np.int32).ravel(),
        corner_edges=corner_edges,
        colors=(mesh.colors_srgb.astype(np.float32) / 255).ravel(),
    )
