"""Volumes of shapes that were not scanned: a CAD mesh, or the points of a model's surface.

They stand in for a reconstruction where a model is given instead of frames; all stages then work as they do on scans.
"""

from collections.abc import Callable

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from datagen.errors import InputError
from fusion.devices import Device, launch_in_slabs
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import Hierarchy
from fusion.volume.block_table import BLOCK_SIDE, BLOCK_VOXELS
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False})

TRUNCATION_VOXELS = 4.0

_NEIGHBOURS = 8
_VIEWS = 162
"""Directions from which points are looked at, to tell which side of a surface is its outside."""
_FEWEST_POINTS = 100
_INSIDE_FROM = 0.375
"""Windings: midway between those at a right edge, a quarter, and at a face, a half."""

Distances = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def volume_from_distances(
    distances: Distances, near_points: NDArray[np.floating], *, voxel_size: float, device: Device
) -> Volume:
    """Return the volume of the shape whose signed distances, metres, negative inside, ``distances`` gives.

    It takes points (n, 3) in the world, and is infinite where nothing is known. ``near_points`` (m, 3) lie on the
    surface, no farther apart than a few voxels; voxels within the truncation, 4 voxels, of the surface count as
    seen once, those beyond as never seen.
    """
    truncation = TRUNCATION_VOXELS * voxel_size
    reach = int(TRUNCATION_VOXELS) + 1
    steps = np.array([-reach, 0, reach])
    corners = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    lattice = np.unique(np.floor(np.asarray(near_points, np.float64) / voxel_size).astype(np.int64), axis=0)
    # Steps of five voxels pass over no block of eight.
    blocks = np.unique((lattice[:, None] + corners).reshape(-1, 3) // BLOCK_SIDE, axis=0).astype(np.int32)
    volume = Volume(voxel_size=voxel_size, truncation=truncation, device=device, max_blocks=len(blocks), storage="full")
    volume.table.adopt(blocks)
    inner = np.stack(np.meshgrid(*3 * [np.arange(BLOCK_SIDE)], indexing="ij"), axis=-1)[..., ::-1].reshape(-1, 3)
    sums = np.empty(len(blocks) * BLOCK_VOXELS, np.float32)
    weight = np.empty_like(sums)
    for first in range(0, len(blocks), 512):
        some = slice(first, first + 512)
        positions = (BLOCK_SIDE * blocks[some, None].astype(np.float64) + inner).reshape(-1, 3) * voxel_size
        share = distances(positions) / truncation
        voxels = slice(first * BLOCK_VOXELS, first * BLOCK_VOXELS + len(share))
        sums[voxels] = np.clip(share, -1, 1)
        weight[voxels] = np.abs(share) <= 1
    sums *= weight
    volume.reserve(len(blocks))
    volume.voxels.distance_sum = wp.array(sums, dtype=float, device=device)
    volume.voxels.weight = wp.array(weight, dtype=float, device=device)
    return volume


@wp.kernel
def _signed_distances(
    first: int, mesh: wp.uint64, points: wp.array(dtype=wp.vec3), reach: float, distances: wp.array(dtype=float)
) -> None:
    index = wp.tid() + first
    point = points[index]
    query = wp.mesh_query_point_sign_winding_number(mesh, point, reach)
    foot = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
    distances[index] = wp.where(query.result, query.sign * wp.length(point - foot), reach)


def volume_from_mesh(mesh: Mesh, *, voxel_size: float, device: Device) -> Volume:
    """Return the volume of a mesh, world frame, whose triangles are counter-clockwise seen from outside.

    Inside is where the mesh winds about a point (Jacobson 2013), so small holes do no harm. Raises InputError for a
    mesh without triangles.
    """
    if not len(mesh.triangles):
        raise InputError("the mesh has no triangles, so there is no shape to locate")
    corners = mesh.vertices[mesh.triangles].astype(np.float64)
    centre = mesh.vertices.mean(axis=0, dtype=np.float64)
    hierarchy = wp.Mesh(
        points=wp.array((mesh.vertices - centre).astype(np.float32), dtype=wp.vec3, device=device),
        indices=wp.array(mesh.triangles.ravel(), dtype=int, device=device),
        support_winding_number=True,
    )
    reach = 4 * TRUNCATION_VOXELS * voxel_size

    def distances(positions: NDArray[np.float64]) -> NDArray[np.float64]:
        points = wp.array((positions - centre).astype(np.float32), dtype=wp.vec3, device=device)
        found = wp.empty(len(positions), dtype=float, device=device)
        launch_in_slabs(
            _signed_distances,
            dim=len(positions),
            inputs=[hierarchy.id, points, reach],
            outputs=[found],
            device=device,
        )
        told = found.numpy().astype(np.float64)
        # A face within another part of the shape is no surface: both of its sides stay inside.
        return np.where(told <= 0, np.minimum(told, -1e-3 * voxel_size), told)

    return volume_from_distances(distances, _cover(corners, voxel_size), voxel_size=voxel_size, device=device)


def _cover(corners: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Return points of triangles (n, 3, 3), so that none of these is farther than about ``spacing`` from one."""
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    pieces = np.maximum(np.ceil(longest / (2 * spacing)).astype(int), 1)
    covered = [corners.reshape(-1, 3)]
    for count in np.unique(pieces):
        if count == 1:
            continue
        i, j = (index.ravel() for index in np.meshgrid(np.arange(count + 1), np.arange(count + 1)))
        keep = i + j <= count
        weights = np.stack([count - i - j, i, j], axis=-1)[keep] / count
        covered.append(np.einsum("kc,ncd->nkd", weights, corners[pieces == count]).reshape(-1, 3))
    return np.concatenate(covered)


def volume_from_points(points: NDArray[np.floating], *, voxel_size: float, device: Device) -> Volume:
    """Return the volume of the surface that points (n, 3), world frame, were sampled from.

    Distances are those to the planes through the nearest points, blended (Kolluri 2008, moving least squares). Where a
    plane goes on beyond the surface's end, what is behind it is not inside: the points, as discs, do not wind around it
    (Barill 2018). Raises InputError where they are too few to tell
    a surface.
    """
    positions = np.asarray(points, dtype=np.float64)
    if len(positions) < _FEWEST_POINTS:
        raise InputError(f"{len(positions)} points do not tell a surface; give at least {_FEWEST_POINTS}")
    normals = outward_normals(positions)
    tree = cKDTree(positions)
    middle = positions.mean(axis=0)
    discs = _discs(positions - middle, normals, tree.query(positions, k=_NEIGHBOURS + 1)[0][:, -1])
    hierarchy = wp.Mesh(
        points=wp.array(discs.vertices, dtype=wp.vec3, device=device),
        indices=wp.array(discs.triangles.ravel(), dtype=int, device=device),
        support_winding_number=True,
    )

    def distances(at: NDArray[np.float64]) -> NDArray[np.float64]:
        apart, nearest = tree.query(at, k=_NEIGHBOURS)
        heights = np.einsum("nkd,nkd->nk", at[:, None] - positions[nearest], normals[nearest])
        # Of a thin wall's two sides the one that is nearer has the say.
        width = np.maximum(apart[:, 2:3], 1e-9)
        agree = np.einsum("nkd,nd->nk", normals[nearest], normals[nearest[:, 0]]) > 0.3
        weights = np.exp(-((apart / width) ** 2)) * agree
        blended = (weights * heights).sum(axis=1) / weights.sum(axis=1)
        behind = np.flatnonzero(blended < 0)
        beyond = behind[~_is_inside(hierarchy, at[behind] - middle, device)]
        blended[beyond] = np.maximum(apart[beyond, 0], -blended[beyond])
        return np.asarray(blended)

    return volume_from_distances(distances, positions, voxel_size=voxel_size, device=device)


def _discs(points: NDArray[np.float64], normals: NDArray[np.float64], reach: NDArray[np.float64]) -> Mesh:
    """Return hexagons around points (n, 3), square to their normals, of the area that is each one's.

    ``reach`` (n,) is the distance of the eighth neighbour: a circle of that radius holds eight points' areas.
    """
    first = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.8, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    # A hexagon's area is 3/2 √3 times the square of its radius.
    radius = reach * np.sqrt(np.pi / (_NEIGHBOURS * 1.5 * 3**0.5))
    around = np.arange(6) * np.pi / 3
    ring = np.cos(around)[:, None] * first[:, None] + np.sin(around)[:, None] * second[:, None]
    corners = np.concatenate([points[:, None], points[:, None] + radius[:, None, None] * ring], axis=1)
    fan = np.stack([np.zeros(6, int), 1 + np.arange(6), 1 + (np.arange(6) + 1) % 6], axis=-1)
    triangles = (7 * np.arange(len(points))[:, None, None] + fan).reshape(-1, 3)
    return Mesh(vertices=corners.reshape(-1, 3).astype(np.float32), triangles=triangles.astype(np.int32))


@wp.kernel
def _windings(
    first: int, mesh: wp.uint64, points: wp.array(dtype=wp.vec3), threshold: float, inside: wp.array(dtype=int)
) -> None:
    index = wp.tid() + first
    found = wp.mesh_query_point_sign_winding_number(mesh, points[index], 1.0e6, 2.0, threshold)
    inside[index] = wp.where(found.sign < 0.0, 1, 0)


def _is_inside(discs: Hierarchy, positions: NDArray[np.float64], device: Device) -> NDArray[np.bool_]:
    """Tell which positions (n, 3), in the frame of the discs, these wind around."""
    if not len(positions):
        return np.zeros(0, bool)
    points = wp.array(positions.astype(np.float32), dtype=wp.vec3, device=device)
    inside = wp.empty(len(positions), dtype=int, device=device)
    launch_in_slabs(
        _windings, dim=len(positions), inputs=[discs.id, points, _INSIDE_FROM], outputs=[inside], device=device
    )
    return np.asarray(inside.numpy() > 0)


def outward_normals(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit normals (n, 3) of the surface that points (n, 3) are of, facing where it can be seen from.

    A normal is the direction of least spread among the nearest points; its sign is that of the mean direction from
    which the point is seen, looked at from all around, each point as a small disc.
    """
    tree = cKDTree(points)
    apart, nearest = tree.query(points, k=_NEIGHBOURS + 1)
    normals = _least_spread(points[nearest], np.ones(nearest.shape))
    seen_from = _mean_view(points, spacing=float(np.median(apart[:, 4])))
    normals *= np.where((normals * seen_from).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    # Again, without the other side of a thin wall.
    agree = np.einsum("nkd,nd->nk", normals[nearest], normals) > 0.5
    refined = _least_spread(points[nearest], agree.astype(np.float64))
    return refined * np.where((refined * normals).sum(axis=1) < 0, -1.0, 1.0)[:, None]


def _least_spread(groups: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit direction (n, 3) along which the points of each group (n, k, 3) spread least."""
    total = weights.sum(axis=1)[:, None]
    offsets = groups - ((weights[..., None] * groups).sum(axis=1) / total)[:, None]
    _values, vectors = np.linalg.eigh(np.einsum("nk,nkd,nke->nde", weights, offsets, offsets))
    return np.ascontiguousarray(vectors[..., 0])


def _mean_view(points: NDArray[np.float64], *, spacing: float) -> NDArray[np.float64]:
    """Return the sum (n, 3) of the directions, among many, from which each point is seen."""
    index = np.arange(_VIEWS) + 0.5
    polar, azimuth = np.arccos(1 - 2 * index / _VIEWS), np.pi * (1 + 5**0.5) * index
    ways = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    total = np.zeros_like(points)
    for way in ways:
        side = np.linalg.svd(way[None])[2][1:]
        pixels = np.floor(points @ side.T / spacing).astype(int)
        pixels -= pixels.min(axis=0) - 1
        height = points @ way
        image = np.full(tuple(pixels.max(axis=0) + 2), -np.inf)
        np.maximum.at(image, tuple(pixels.T), height)
        nearest = ndimage.maximum_filter(image, size=3)
        total += way * (height > nearest[tuple(pixels.T)] - 1.5 * spacing)[:, None]
    return total
