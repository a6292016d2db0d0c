"""A ray's way through the sparse blocks, to where it first meets the surface from outside.

A block that is missing or without surface is passed in one step. In a block with surface the ray goes from cell to
cell, and where a cell holds surface, the field along the ray is a cubic whose first fall through zero is found to
rounding: no step length is chosen and nothing is stepped over. A rise through zero is a back face, where the ray ends
without surface.
"""

import warp as wp

from fusion.surface.layers import NONE
from fusion.volume.block_table import BLOCK_VOXELS, find_block
from fusion.volume.trilinear import BACK_FACE, NO_CROSSING, Corners, cubic_along, cubic_at, first_crossing
from fusion.volume.voxels import Voxels, distance_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_VOXELS = wp.constant(BLOCK_VOXELS)

_ENTRY_TOLERANCE = wp.constant(1.0e-4)
"""A ray that enters its first surface cell this little below zero, in truncations, entered at the surface: the corners
of the cell before were all outside, and rounding alone put it within."""


@wp.struct
class Scene:
    """What rays are cast into: see ``SurfaceCells``; ``keys`` are the block table's."""

    keys: wp.array(dtype=wp.int64)
    numbers: wp.array(dtype=int)
    layers: wp.array(dtype=wp.uint64)
    neighbours: wp.array2d(dtype=int)
    low: wp.vec3i
    high: wp.vec3i
    voxels: Voxels


@wp.struct
class Ray:
    """``origin_cell`` + ``origin`` + t·``direction`` in voxels, t in metres of planar depth.

    ``origin_cell`` is whole, so that positions keep their digits far from the world's origin.
    """

    origin_cell: wp.vec3i
    origin: wp.vec3
    direction: wp.vec3
    inverse: wp.vec3


@wp.struct
class Hit:
    """Where a ray met the surface: ``depth``, 0 for nowhere; in ``cell`` of block ``number``, where ``at`` in it."""

    depth: float
    number: int
    cell: wp.vec3i
    at: wp.vec3


@wp.func
def corner_voxel(neighbours: wp.array2d(dtype=int), number: int, cell: wp.vec3i, corner: int) -> int:
    """Return the index of a cell's corner; for cells whose corners all exist."""
    x = cell[0] + (corner & 1)
    y = cell[1] + ((corner >> 1) & 1)
    z = cell[2] + (corner >> 2)
    holder = neighbours[number, (x >> 3) + 2 * (y >> 3) + 4 * (z >> 3)]
    return holder * _VOXELS + (z & 7) * 64 + (y & 7) * 8 + (x & 7)


@wp.func
def corner_distances(scene: Scene, number: int, cell: wp.vec3i) -> Corners:
    """Return the average distances at a cell's corners, in truncations."""
    v = Corners()
    for corner in range(8):
        v[corner] = distance_of(scene.voxels, corner_voxel(scene.neighbours, number, cell, corner))
    return v


@wp.func
def exit_times(ray: Ray, corner: wp.vec3i, side: int) -> wp.vec3:
    """Return when, along each axis, the ray leaves the cube of ``side`` voxels from lattice point ``corner`` on."""
    t = wp.vec3()
    for axis in range(3):
        wall = corner[axis] - ray.origin_cell[axis]
        if ray.direction[axis] > 0.0:
            wall += side
        t[axis] = (float(wall) - ray.origin[axis]) * ray.inverse[axis]
    return t


@wp.func
def earliest(t: wp.vec3) -> int:
    """Return the axis of the least component."""
    if t[0] < t[1]:
        return wp.where(t[0] < t[2], 0, 2)
    return wp.where(t[1] < t[2], 1, 2)


@wp.func
def position_in(ray: Ray, corner: wp.vec3i, t: float) -> wp.vec3:
    """Return where the ray is at t, in voxels from lattice point ``corner``."""
    offset = ray.origin_cell - corner
    return wp.vec3(float(offset[0]), float(offset[1]), float(offset[2])) + ray.origin + t * ray.direction


@wp.func
def cell_at(position: wp.vec3) -> wp.vec3i:
    """Return the cell of a block that holds a position, the nearest one where rounding put it outside."""
    cell = wp.vec3i()
    for axis in range(3):
        cell[axis] = wp.clamp(int(wp.floor(position[axis])), 0, 7)
    return cell


@wp.func
def crossing_in_cell(c: wp.vec4, side_before: int) -> float:
    """Return the first crossing of a cell's cubic, which rounding must not hide between this cell and the one before.

    ``side_before`` is the sign with which the ray left the surface cell before this one, 0 if there was none.
    """
    if side_before > 0 and c[0] < 0.0:
        return 0.0
    if side_before < 0 and c[0] >= 0.0:
        return BACK_FACE
    if side_before == 0 and c[0] < 0.0 and c[0] > -_ENTRY_TOLERANCE:
        return first_crossing(wp.vec4(0.0, c[1], c[2], c[3]))
    return first_crossing(c)


@wp.func
def cross_block(
    scene: Scene, ray: Ray, number: int, block: wp.vec3i, t_start: float, t_end: float, side_before: int
) -> tuple[float, int, wp.vec3i, wp.vec3]:
    """Follow the ray through a block's cells, from t_start to t_end.

    Returns the depth of the surface, 0 where there is none and BACK_FACE where the ray ends at one; the sign with which
    it left the last cell if that held surface, else 0; and the cell of the surface, and where in it.
    """
    corner = 8 * block
    t = float(t_start)
    side = int(side_before)
    cell = cell_at(position_in(ray, corner, t))
    inside = int(1)
    while inside == 1 and t < t_end:
        times = exit_times(ray, corner + cell, 1)
        axis = earliest(times)
        t_exit = wp.clamp(times[axis], t, t_end)
        bit = wp.uint64(8 * cell[1] + cell[0])
        if (scene.layers[8 * number + cell[2]] >> bit) & wp.uint64(1) != NONE:
            a = position_in(ray, corner + cell, t)
            b = position_in(ray, corner + cell, t_exit)
            c = cubic_along(corner_distances(scene, number, cell), a, b)
            s = crossing_in_cell(c, side)
            if s == BACK_FACE:
                return BACK_FACE, 0, cell, a
            if s != NO_CROSSING:
                return t + s * (t_exit - t), 0, cell, a + s * (b - a)
            side = wp.where(cubic_at(c, 1.0) < 0.0, -1, 1)
        else:
            side = 0
        t = t_exit
        cell[axis] = cell[axis] + wp.where(ray.direction[axis] > 0.0, 1, -1)
        if cell[axis] < 0 or cell[axis] > 7:
            inside = 0
    return 0.0, side, cell, wp.vec3()


@wp.func
def cast_ray(scene: Scene, ray: Ray, depth_min: float, depth_max: float) -> Hit:
    """Return where a ray first meets the surface from outside."""
    hit = Hit()
    t = float(depth_min)
    t_end = float(depth_max)
    for axis in range(3):
        one = (float(8 * scene.low[axis] - ray.origin_cell[axis]) - ray.origin[axis]) * ray.inverse[axis]
        other = (float(8 * scene.high[axis] + 8 - ray.origin_cell[axis]) - ray.origin[axis]) * ray.inverse[axis]
        t = wp.max(t, wp.min(one, other))
        t_end = wp.min(t_end, wp.max(one, other))
    start = position_in(ray, 8 * scene.low, t)
    block = wp.vec3i()
    for axis in range(3):
        block[axis] = wp.clamp(scene.low[axis] + int(wp.floor(start[axis] / 8.0)), scene.low[axis], scene.high[axis])
    side = int(0)
    while t < t_end:
        times = exit_times(ray, 8 * block, 8)
        axis = earliest(times)
        t_exit = wp.clamp(times[axis], t, t_end)
        number = find_block(scene.keys, scene.numbers, block)
        if number < 0:
            side = 0
        else:
            depth, side_after, cell, at = cross_block(scene, ray, number, block, t, t_exit, side)
            if depth == BACK_FACE:
                return hit
            if depth > 0.0:
                hit.depth = depth
                hit.number = number
                hit.cell = cell
                hit.at = at
                return hit
            side = side_after
        t = t_exit
        block[axis] = block[axis] + wp.where(ray.direction[axis] > 0.0, 1, -1)
        if block[axis] < scene.low[axis] or block[axis] > scene.high[axis]:
            return hit
    return hit
