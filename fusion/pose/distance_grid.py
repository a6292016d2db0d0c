"""A surface's signed distance on a coarse, dense grid: where a point far from the surface has to go.

A fused volume knows distances in a band around the surface alone. The grid knows them everywhere in a box around the
model, so that a pose that is far off is drawn in and a ray that misses the model knows by how much.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy import ndimage

from fusion.devices import Device, launch_in_slabs
from fusion.surface.mesh import Mesh

wp.set_module_options({"enable_backward": False})

NODES = 96
"""Along the longest side of the box."""

MARGIN_SHARE, LARGEST_MARGIN = 0.25, 0.3
"""Of the box around the model, as a share of its longest side, and in metres."""

INSIDE_FROM, OUTSIDE_BELOW = 0.7, 0.1
"""Windings of a surface around what is surely inside of it, and surely not."""

_ASKED_OF_A_REGION = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class DistanceGrid:
    """Signed distances at the nodes of a dense grid, metres, negative behind the surface.

    ``distances`` (nx, ny, nz) float32 on a device; node (i, j, k) lies at ``origin_world`` + ``spacing`` · (i, j, k).
    """

    distances: wp.array
    origin_world: NDArray[np.float64]
    spacing: float


def distance_grid(mesh: Mesh, *, device: Device, nodes: int = NODES) -> DistanceGrid:
    """Return the grid around ``mesh``, whose vertices have normals and lie closer together than the grid's nodes.

    At the corners of the cells that hold vertices, and next to them, the distance is exact, to the closest triangle.
    Farther out it is that to the closest point of the nearest such node: never too small, and too large by no more than
    2 √3 spacings and the gap between vertices. For a vertex p that lies within the gap h of the point closest to a node
    x, at the distance d, has a corner of its cell no farther from x than itself; so the node n that is taken is no
    farther than d + h, and the closest point of n, from which n is two cells at most along each axis, no farther than
    d + h + 2 √3. On average of fused models it is a tenth of a spacing.
    """
    low, high = mesh.vertices.min(axis=0).astype(np.float64), mesh.vertices.max(axis=0).astype(np.float64)
    side = float((high - low).max())
    margin = min(MARGIN_SHARE * side, LARGEST_MARGIN)
    spacing = (side + 2 * margin) / (nodes - 1)
    shape = np.ceil((high - low + 2 * margin) / spacing).astype(int) + 1
    origin = low - margin
    near = _nodes_next_to(mesh.vertices, origin, spacing, shape)
    near_positions = origin + spacing * near
    # A node next to the surface is within two cells of a point of it.
    feet, signs = _closest(mesh, near_positions, 4 * spacing, device)
    foot_of = np.zeros((*shape, 3), np.float32)
    sign_of = np.zeros(tuple(shape), np.float32)
    outside = np.ones(tuple(shape), bool)
    at = tuple(near.T)
    foot_of[at], sign_of[at], outside[at] = feet - origin, signs, False
    nearest = ndimage.distance_transform_edt(outside, return_distances=False, return_indices=True)
    positions = spacing * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1, dtype=np.float32)
    signs_everywhere = _mend_sides(mesh, sign_of[tuple(nearest)], outside, origin, spacing, device)
    distances = np.linalg.norm(positions - foot_of[tuple(nearest)], axis=-1) * signs_everywhere
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


@wp.kernel
def _feet(
    first: int,
    mesh: wp.uint64,
    normals: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
    reach: float,
    feet: wp.array(dtype=wp.vec3),
    signs: wp.array(dtype=float),
) -> None:
    index = wp.tid() + first
    point = points[index]
    query = wp.mesh_query_point_no_sign(mesh, point, reach)
    foot = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
    # By the vertices' normals, which are the field's gradients: triangles may have no area, and so no normal.
    a = normals[wp.mesh_get_index(mesh, 3 * query.face)]
    b = normals[wp.mesh_get_index(mesh, 3 * query.face + 1)]
    c = normals[wp.mesh_get_index(mesh, 3 * query.face + 2)]
    normal = query.u * a + query.v * b + (1.0 - query.u - query.v) * c
    feet[index] = foot
    signs[index] = wp.where(wp.dot(point - foot, normal) < 0.0, -1.0, 1.0)


def _closest(
    mesh: Mesh, positions: NDArray[np.float64], reach: float, device: Device
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the closest points (n, 3) of the mesh, and on which side of it the positions are (n,), ±1."""
    centre = positions.mean(axis=0)
    hierarchy = wp.Mesh(
        points=wp.array((mesh.vertices - centre).astype(np.float32), dtype=wp.vec3, device=device),
        indices=wp.array(mesh.triangles.ravel(), dtype=int, device=device),
    )
    points = wp.array((positions - centre).astype(np.float32), dtype=wp.vec3, device=device)
    feet = wp.empty(len(positions), dtype=wp.vec3, device=device)
    signs = wp.empty(len(positions), dtype=float, device=device)
    launch_in_slabs(
        _feet,
        dim=len(positions),
        inputs=[hierarchy.id, wp.array(mesh.normals, dtype=wp.vec3, device=device), points, reach],
        outputs=[feet, signs],
        device=device,
    )
    return feet.numpy() + centre, signs.numpy().astype(np.float64)


@wp.kernel
def _windings(
    first: int,
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    threshold: float,
    inside: wp.array(dtype=int),
) -> None:
    index = wp.tid() + first
    found = wp.mesh_query_point_sign_winding_number(mesh, points[index], 1.0e6, 2.0, threshold)
    inside[index] = wp.where(found.sign < 0.0, 1, 0)


def _mend_sides(
    mesh: Mesh,
    sides: NDArray[np.float32],
    far: NDArray[np.bool_],
    origin: NDArray[np.float64],
    spacing: float,
    device: Device,
) -> NDArray[np.float32]:
    """Return the ``sides`` (nx, ny, nz), ±1, without the wedges that a wrong sign next to the surface carries outward.

    Connected nodes of one side are judged together, by how often the surface winds around them (Jacobson and others
    2013), which no hole in it changes much: as in a model whose bottom was never seen, where inside and outside are one
    region. A surface seen from one side alone, as that of a room, winds around nothing, and is left as it is.
    """
    centre = mesh.vertices.mean(axis=0)
    hierarchy = wp.Mesh(
        points=wp.array((mesh.vertices - centre).astype(np.float32), dtype=wp.vec3, device=device),
        indices=wp.array(mesh.triangles.ravel(), dtype=int, device=device),
        support_winding_number=True,
    )
    mended = sides.copy()
    for side, threshold in ((1.0, INSIDE_FROM), (-1.0, OUTSIDE_BELOW)):
        regions, count = ndimage.label(far & (sides == side))
        if not count:
            continue
        nodes = np.argwhere(regions)
        numbers = regions[tuple(nodes.T)]
        asked = _some_of_each(numbers)
        points = wp.array((origin + spacing * nodes[asked] - centre).astype(np.float32), dtype=wp.vec3, device=device)
        inside = wp.empty(len(asked), dtype=int, device=device)
        launch_in_slabs(
            _windings, dim=len(asked), inputs=[hierarchy.id, points, threshold], outputs=[inside], device=device
        )
        share = np.bincount(numbers[asked], inside.numpy(), count + 1) / np.bincount(
            numbers[asked], minlength=count + 1
        ).clip(1)
        wrong = share > 0.5 if side > 0 else share < 0.5
        wrong[0] = False
        mended[wrong[regions]] = -side
    return mended


def _some_of_each(numbers: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return the indices of up to ``_ASKED_OF_A_REGION`` places (n,) of each number, spread over the list."""
    order = np.argsort(numbers, kind="stable")
    counts = np.bincount(numbers)
    rank = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    stride = np.maximum(counts // _ASKED_OF_A_REGION, 1)
    return order[rank % stride[numbers[order]] == 0]
