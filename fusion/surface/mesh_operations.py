"""What is done to a mesh after it was extracted: keeping its large parts, finding holes, smoothing, decimating."""

from dataclasses import dataclass

import fast_simplification
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse

from datagen.errors import InputError
from fusion.devices import Device
from fusion.surface.closest_points import closest_points
from fusion.surface.mesh import Mesh

TAUBIN_LAMBDA = 0.5
TAUBIN_PASS_BAND = 0.1
"""Taubin's k = 1/λ + 1/μ: below this frequency of the umbrella operator, shape is kept."""


@dataclass(frozen=True, kw_only=True)
class Hole:
    """A closed loop of ``edges`` that only one triangle has: its ``length`` and ``centre`` (3,), metres, world."""

    edges: int
    length: float
    centre: tuple[float, float, float]


def component_labels(mesh: Mesh) -> NDArray[np.int32]:
    """Return for each triangle (m,) the number of the connected component, over shared vertices, that it is in."""
    count = len(mesh.vertices)
    edges = np.concatenate([mesh.triangles[:, [0, 1]], mesh.triangles[:, [1, 2]]])
    graph = sparse.coo_array((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), shape=(count, count))
    return sparse.csgraph.connected_components(graph, directed=False)[1][mesh.triangles[:, 0]]


def largest_component(mesh: Mesh) -> Mesh:
    """Return the connected component with the largest area."""
    labels = component_labels(mesh)
    areas = np.bincount(labels, weights=_areas(mesh))
    return _select(mesh, labels == areas.argmax())


def without_small_components(mesh: Mesh, least_triangles: int) -> Mesh:
    """Return the connected components of at least ``least_triangles``; raises InputError where none is that large."""
    labels = component_labels(mesh)
    counts = np.bincount(labels)
    if counts.max() < least_triangles:
        raise InputError(
            f"no component has {least_triangles:,} triangles, the largest has {counts.max():,}; ask for fewer"
        )
    return _select(mesh, counts[labels] >= least_triangles)


def holes(mesh: Mesh) -> list[Hole]:
    """Return the loops of border edges, the longest first.

    A loop that touches itself at a vertex counts as one hole. What the camera never saw makes one loop too, so an open
    scan has at least one.
    """
    edges = _border_edges(mesh)
    if len(edges) == 0:
        return []
    used, index = np.unique(edges, return_inverse=True)
    ends = index.reshape(edges.shape)
    graph = sparse.coo_array((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(len(used), len(used)))
    count, vertex_loops = sparse.csgraph.connected_components(graph, directed=False)
    loops = vertex_loops[ends[:, 0]]
    points = mesh.vertices[edges].astype(np.float64)
    lengths = np.linalg.norm(points[:, 1] - points[:, 0], axis=1)
    totals, sizes = np.bincount(loops, weights=lengths), np.bincount(loops)
    middles = points.mean(axis=1)
    centres = np.stack([np.bincount(loops, weights=middles[:, axis]) / sizes for axis in range(3)], axis=1)
    order = np.argsort(-totals, kind="stable")[:count]
    return [
        Hole(edges=int(sizes[i]), length=float(totals[i]), centre=(float(x), float(y), float(z)))
        for i, (x, y, z) in zip(order, centres[order], strict=True)
    ]


def smooth(mesh: Mesh, iterations: int) -> Mesh:
    """Smooth by Taubin's λ|μ filter ("A signal processing approach to fair surface design", 1995), with normals anew.

    Each iteration is a step of λ = 0.5 towards the neighbours' mean and one of μ away from it, so that noise goes and
    the volume stays. Vertices of the border stay where they are, and so do colours.
    """
    away = 1 / (1 / TAUBIN_LAMBDA - TAUBIN_PASS_BAND)  # −μ
    shape = _trimesh(mesh)
    laplacian = trimesh.smoothing.laplacian_calculation(shape, pinned_vertices=np.unique(_border_edges(mesh)))
    trimesh.smoothing.filter_taubin(
        shape, lamb=TAUBIN_LAMBDA, nu=away, iterations=2 * iterations, laplacian_operator=laplacian
    )
    return Mesh(
        vertices=shape.vertices.astype(np.float32),
        triangles=mesh.triangles,
        colors=mesh.colors,
        normals=None if mesh.normals is None else shape.vertex_normals.astype(np.float32),
    )


def decimate(mesh: Mesh, triangles: int, *, device: Device) -> Mesh:
    """Collapse edges by quadric error (Garland and Heckbert 1997) until about ``triangles`` are left.

    Edges of no length go first: marching cubes makes them where the surface passes through voxels, and the triangles
    there, without a normal, would keep all that are around.
    Colours are those of the closest points of the mesh before; normals are made anew. Raises InputError where the
    number is not between 4 and the mesh's own.
    """
    if not 4 <= triangles <= len(mesh.triangles):
        raise InputError(
            f"cannot decimate {len(mesh.triangles):,} triangles to {triangles:,}; expected 4 to as many as there are"
        )
    centre = mesh.vertices.astype(np.float64).mean(axis=0)
    points, faces = _without_edges_of_no_length(mesh)
    points = points - centre
    if triangles < len(faces):
        points, faces = fast_simplification.simplify(points, faces, target_count=triangles)
    vertices = (points + centre).astype(np.float32)
    fewer = Mesh(vertices=vertices, triangles=np.asarray(faces, np.int32))
    return Mesh(
        vertices=fewer.vertices,
        triangles=fewer.triangles,
        colors=None if mesh.colors is None else _colors_at(mesh, points + centre, device=device),
        normals=None if mesh.normals is None else _trimesh(fewer).vertex_normals.astype(np.float32),
    )


def _without_edges_of_no_length(mesh: Mesh) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return the vertices and triangles of a mesh whose edges without length are collapsed."""
    edges = mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = edges[(mesh.vertices[edges[:, 0]] == mesh.vertices[edges[:, 1]]).all(axis=1)]
    if len(edges) == 0:
        return mesh.vertices, mesh.triangles
    count = len(mesh.vertices)
    graph = sparse.coo_array((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), shape=(count, count))
    _, places = sparse.csgraph.connected_components(graph, directed=False)
    corners = places[mesh.triangles]
    distinct = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    _, first = np.unique(places, return_index=True)
    return mesh.vertices[first], corners[distinct].astype(np.int32)


def _colors_at(mesh: Mesh, points: NDArray[np.float64], *, device: Device) -> NDArray[np.uint8]:
    """Return the colours (n, 3) that ``mesh`` has closest to ``points`` (n, 3)."""
    assert mesh.colors is not None
    corners = mesh.triangles[closest_points(mesh, points, device=device).triangles]
    places = mesh.vertices.astype(np.float64)[corners]
    with np.errstate(divide="ignore", invalid="ignore"):  # in a triangle without area
        weights = trimesh.triangles.points_to_barycentric(places, points)
    # The closest point is inside its triangle; a vertex off the surface projects to somewhere near it.
    weights = np.clip(np.nan_to_num(weights, nan=1 / 3), 0, 1)
    weights /= weights.sum(axis=1, keepdims=True)
    return np.rint(np.einsum("nk,nkc->nc", weights, mesh.colors[corners].astype(np.float64))).astype(np.uint8)


def _select(mesh: Mesh, chosen: NDArray[np.bool_]) -> Mesh:
    """Return some of a mesh's triangles, and the vertices that they have."""
    used, corners = np.unique(mesh.triangles[chosen], return_inverse=True)
    return Mesh(
        vertices=mesh.vertices[used],
        triangles=corners.reshape(-1, 3).astype(np.int32),
        colors=None if mesh.colors is None else mesh.colors[used],
        normals=None if mesh.normals is None else mesh.normals[used],
    )


def _border_edges(mesh: Mesh) -> NDArray[np.int64]:
    """Return the edges (n, 2) that exactly one triangle has."""
    edges = np.sort(mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    keys, counts = np.unique(edges[:, 0] * len(mesh.vertices) + edges[:, 1], return_counts=True)
    return np.stack(np.divmod(keys[counts == 1], len(mesh.vertices)), axis=1)


def _areas(mesh: Mesh) -> NDArray[np.float64]:
    a, b, c = np.moveaxis(mesh.vertices.astype(np.float64)[mesh.triangles], 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def _trimesh(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices.astype(np.float64), mesh.triangles, process=False)
