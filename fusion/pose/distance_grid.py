"""A surface's signed distance on a coarse, dense grid: where a point far from the surface has to go.

A fused volume knows distances in a band around the surface alone. The grid knows them everywhere in a box around the
model, so that a pose that is far off is drawn in and a ray that misses the model knows by how much.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy import ndimage

from fusion.devices import Device
from fusion.surface.closest_points import closest_points
from fusion.surface.mesh import Mesh

NODES = 96
"""Along the longest side of the box."""

MARGIN_SHARE, LARGEST_MARGIN = 0.25, 0.3
"""Of the box around the model, as a share of its longest side, and in metres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DistanceGrid:
    """Signed distances at the nodes of a dense grid, metres, negative behind the surface.

    ``distances`` (nx, ny, nz) float32 on a device; node (i, j, k) lies at ``origin_world`` + ``spacing`` · (i, j, k).
    """

    distances: wp.array
    origin_world: NDArray[np.float64]
    spacing: float


def distance_grid(mesh: Mesh, *, device: Device, nodes: int = NODES) -> DistanceGrid:
    """Return the grid around ``mesh``, whose vertices have normals and lie closer than the grid's nodes.

    Next to the surface the distance is exact, to the closest triangle; farther out it is that to the closest point of
    the nearest node that is next to the surface, right to a small share of the spacing.
    """
    assert mesh.normals is not None, "the sign of a distance is told by normals"
    low, high = mesh.vertices.min(axis=0).astype(np.float64), mesh.vertices.max(axis=0).astype(np.float64)
    side = float((high - low).max())
    margin = min(MARGIN_SHARE * side, LARGEST_MARGIN)
    spacing = (side + 2 * margin) / (nodes - 1)
    shape = np.ceil((high - low + 2 * margin) / spacing).astype(int) + 1
    origin = low - margin
    near = _nodes_next_to(mesh.vertices, origin, spacing, shape)
    near_positions = origin + spacing * near
    feet, signs = _closest(mesh, near_positions, device)
    foot_of = np.zeros((*shape, 3), np.float32)
    sign_of = np.zeros(tuple(shape), np.float32)
    outside = np.ones(tuple(shape), bool)
    at = tuple(near.T)
    foot_of[at], sign_of[at], outside[at] = feet - origin, signs, False
    nearest = ndimage.distance_transform_edt(outside, return_distances=False, return_indices=True)
    positions = spacing * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1, dtype=np.float32)
    distances = np.linalg.norm(positions - foot_of[tuple(nearest)], axis=-1) * sign_of[tuple(nearest)]
    return DistanceGrid(
        distances=wp.array(distances.astype(np.float32), dtype=float, device=device),
        origin_world=origin,
        spacing=spacing,
    )


def _nodes_next_to(
    points: NDArray[np.float32], origin: NDArray[np.float64], spacing: float, shape: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the nodes (n, 3) at the corners of the cells that hold points, and of those around them."""
    occupied = np.zeros(tuple(shape), bool)
    occupied[tuple(np.floor((points - origin) / spacing).astype(int).T)] = True
    wide = ndimage.binary_dilation(occupied, np.ones((3, 3, 3), bool))
    return np.argwhere(wide)


def _closest(
    mesh: Mesh, positions: NDArray[np.float64], device: Device
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the closest points (n, 3) of the mesh, and on which side of it the positions are (n,), ±1."""
    found = closest_points(mesh, positions, device=device)
    corners = mesh.vertices[mesh.triangles[found.triangles]].astype(np.float64)
    feet = _closest_in_triangles(corners, positions)
    assert mesh.normals is not None
    # The closest vertex' normal tells the sides apart at edges, too, where the triangles' own normals disagree.
    share = 1 / (np.linalg.norm(feet[:, None] - corners, axis=2) + 1e-12)
    normals = (mesh.normals[mesh.triangles[found.triangles]] * share[..., None]).sum(axis=1)
    sides = np.where(((positions - feet) * normals).sum(axis=1) < 0, -1.0, 1.0)
    return feet, sides


def _closest_in_triangles(corners: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the point of each triangle (n, 3, 3) that is closest to each of ``points`` (n, 3)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    area = (normal**2).sum(axis=1)
    safe = np.where(area > 0, area, 1)
    v = (np.cross(points - a, c - a) * normal).sum(axis=1) / safe
    w = (np.cross(b - a, points - a) * normal).sum(axis=1) / safe
    inside = (area > 0) & (v >= 0) & (w >= 0) & (v + w <= 1)
    best = a + v[:, None] * (b - a) + w[:, None] * (c - a)
    least = np.where(inside, -1.0, np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        length = np.maximum((edge**2).sum(axis=1), 1e-30)
        along = np.clip(((points - start) * edge).sum(axis=1) / length, 0, 1)
        candidate = start + along[:, None] * edge
        distance = ((points - candidate) ** 2).sum(axis=1)
        nearer = distance < least
        best[nearer], least[nearer] = candidate[nearer], distance[nearer]
    return best
