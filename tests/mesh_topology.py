"""What a mesh is as a surface: manifold or not, closed or not, and whether it meets itself, by an exact library."""

import igl.copyleft.cgal
import numpy as np
from scipy import sparse


def edge_uses(mesh):
    """Return the edges (n, 2), ascending, and how many triangles have each."""
    corners = mesh.triangles
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    return np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)


def is_manifold(mesh):
    """Return whether each edge has one or two triangles, facing alike, and those around a vertex are one fan."""
    corners = mesh.triangles.astype(np.int64)
    count = len(corners)
    directed = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    if len(np.unique(directed, axis=0)) < len(directed):
        return False
    # A node is a triangle's corner; two are joined where their triangles share an edge at that vertex.
    slots = {0: (0, 1), 1: (1, 2), 2: (2, 0)}
    face = np.tile(np.arange(count), 3)
    starts = np.concatenate([3 * np.arange(count) + slots[i][0] for i in range(3)])
    ends = np.concatenate([3 * np.arange(count) + slots[i][1] for i in range(3)])
    order = np.lexsort(np.sort(directed, axis=1).T[::-1])
    ordered = np.sort(directed, axis=1)[order]
    same = np.flatnonzero((ordered[1:] == ordered[:-1]).all(1))
    a, b = order[same], order[same + 1]
    assert (face[a] != face[b]).all()
    # Opposite directions: the start of one is the end of the other.
    joined = np.concatenate([np.stack([starts[a], ends[b]]), np.stack([ends[a], starts[b]])], axis=1)
    graph = sparse.coo_array((np.ones(joined.shape[1]), joined), shape=(3 * count, 3 * count))
    fans, _ = sparse.csgraph.connected_components(graph, directed=False)
    return fans == len(np.unique(corners))


def is_closed(mesh):
    """Return whether every edge has two triangles."""
    return bool((edge_uses(mesh)[1] == 2).all())


def self_intersections(mesh):
    """Return how many pairs of triangles meet other than in a common edge or vertex, in exact arithmetic (CGAL)."""
    found = igl.copyleft.cgal.remesh_self_intersections(
        mesh.vertices.astype(np.float64), mesh.triangles.astype(np.int64), detect_only=True
    )
    return len(found[2])


def enclosed_volume(mesh):
    """Return the signed volume that a closed mesh encloses."""
    a, b, c = np.moveaxis(mesh.vertices.astype(np.float64)[mesh.triangles], 1, 0)
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6
