"""Ray casting: the surface as a camera sees it, straight from the volume.

A ray passes blocks that are missing or without surface in one step each. In a block with surface it goes from cell to
cell, and where a cell holds surface, the field along the ray is a cubic whose first fall through zero is found to
rounding: no step length is chosen and nothing is stepped over. A rise through zero is a back face, where the ray ends
without surface. Surface is where marching cubes has it, in cells whose eight corners were all seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import Matrix, rigid
from fusion.block_table import BLOCK_VOXELS, find_block
from fusion.devices import launch_in_slabs
from fusion.surface_cells import SurfaceCells, find_surface_cells
from fusion.trilinear import (
    BACK_FACE,
    NO_CROSSING,
    Corners,
    cubic_along,
    cubic_at,
    first_crossing,
    trilinear_gradient,
)
from fusion.volume import Volume
from fusion.voxels import Voxels, distance_of, sums_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_VOXELS = wp.constant(BLOCK_VOXELS)

_ENTRY_TOLERANCE = wp.constant(1.0e-4)
"""A ray that enters its first surface cell this little below zero, in truncations, entered at the surface: the corners
of the cell before were all outside, and rounding alone put it within."""

_LEAST_SLOPE = wp.constant(1.0e-9)
"""Stands for 0 in a ray's direction, so that its reciprocal is finite."""


FARTHEST = 1 << 30
"""Of a camera from the world's origin, in voxels, which are counted in 32 bits."""


@dataclass(frozen=True, kw_only=True)
class RayCast:
    """What a camera sees of a volume.

    ``depth`` (height, width) float32 planar metres, 0 where there is no surface; ``normals`` (height, width, 3) float32
    unit vectors in the world frame, out of the surface, 0 where there is none; ``color`` (height, width, 3) uint8 RGB,
    black where there is no surface or the surface has no colour.
    """

    depth: NDArray[np.float32]
    normals: NDArray[np.float32]
    color: NDArray[np.uint8]


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
    """Where a ray met the surface: ``depth`` (0 for nowhere), the ``cell`` of block ``number``, and where ``at`` in it."""

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
def corner_colors(scene: Scene, hit: Hit) -> wp.vec3:
    """Return the colour at a hit, interpolated among the corners that have one; black where none has."""
    mixed = wp.vec3()
    share = float(0.0)
    for corner in range(8):
        sums = sums_of(scene.voxels, corner_voxel(scene.neighbours, hit.number, hit.cell, corner))
        if sums.color_weight > 0.0:
            x = wp.where((corner & 1) == 1, hit.at[0], 1.0 - hit.at[0])
            y = wp.where(((corner >> 1) & 1) == 1, hit.at[1], 1.0 - hit.at[1])
            z = wp.where((corner >> 2) == 1, hit.at[2], 1.0 - hit.at[2])
            mixed += x * y * z / sums.color_weight * sums.color
            share += x * y * z
    if share > 0.0:
        return mixed / share
    return wp.vec3()


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
    if side_before > 0:
        if c[0] < 0.0:
            return 0.0
    if side_before < 0:
        if c[0] >= 0.0:
            return BACK_FACE
    if side_before == 0:
        if c[0] < 0.0:
            if c[0] > -_ENTRY_TOLERANCE:
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
        if (scene.layers[8 * number + cell[2]] >> bit) & wp.uint64(1) != wp.uint64(0):
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


@wp.kernel
def _cast_rays(
    first: int,
    scene: Scene,
    origin_cells: wp.array(dtype=wp.vec3i),
    origins: wp.array(dtype=wp.vec3),
    rotations: wp.array(dtype=wp.mat33),  # voxels from metres along the camera's axes
    intrinsics: wp.vec4,  # fx, fy, cx, cy
    depth_min: float,
    depth_max: float,
    depth: wp.array3d(dtype=float),
    normals: wp.array3d(dtype=wp.vec3),
    color: wp.array4d(dtype=wp.uint8),
) -> None:
    index = wp.tid() + first
    width = depth.shape[2]
    height = depth.shape[1]
    u = index % width
    v = (index / width) % height
    pose = index / (width * height)
    x = (float(u) - intrinsics[2]) / intrinsics[0]
    y = (float(v) - intrinsics[3]) / intrinsics[1]
    ray = Ray()
    ray.origin_cell = origin_cells[pose]
    ray.origin = origins[pose]
    ray.direction = rotations[pose] * wp.vec3(x, y, 1.0)
    for axis in range(3):
        if wp.abs(ray.direction[axis]) < _LEAST_SLOPE:
            ray.direction[axis] = _LEAST_SLOPE
        ray.inverse[axis] = 1.0 / ray.direction[axis]
    hit = cast_ray(scene, ray, depth_min, depth_max)
    depth[pose, v, u] = hit.depth
    if normals.shape[0] == 0:
        return
    if hit.depth > 0.0:
        normals[pose, v, u] = wp.normalize(trilinear_gradient(corner_distances(scene, hit.number, hit.cell), hit.at))
        mixed = corner_colors(scene, hit)
        for channel in range(3):
            color[pose, v, u, channel] = wp.uint8(wp.clamp(mixed[channel] + 0.5, 0.0, 255.0))


def _cast(
    volume: Volume,
    camera: PinholeCamera,
    poses: Sequence[Matrix],
    *,
    depth_min: float,
    depth_max: float,
    min_weight: float,
    shaded: bool,
) -> tuple[wp.array, wp.array, wp.array]:
    """Return depth, normals and colours from each pose; without ``shaded`` the last two are empty."""
    if not 0 <= depth_min < depth_max:
        raise InputError(f"depth from {depth_min:g} to {depth_max:g} m: expected 0 ≤ nearest < farthest")
    device = volume.device
    shape = (len(poses), camera.height, camera.width)
    depth = wp.zeros(shape, dtype=float, device=device)
    normals = wp.zeros(shape if shaded else (0, 0, 0), dtype=wp.vec3, device=device)
    color = wp.zeros((*shape, 3) if shaded else (0, 0, 0, 0), dtype=wp.uint8, device=device)
    cells = find_surface_cells(volume, min_weight=min_weight)
    if cells.bounds is None:
        return depth, normals, color
    launch_in_slabs(
        _cast_rays,
        dim=depth.size,
        inputs=[
            _scene(volume, cells),
            *_rays(volume, poses),
            wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy),
            depth_min,
            depth_max,
        ],
        outputs=[depth, normals, color],
        device=device,
    )
    return depth, normals, color


def _scene(volume: Volume, cells: SurfaceCells) -> Scene:
    """Return what the kernel takes of a volume that holds surface."""
    assert cells.bounds is not None
    scene = Scene()
    scene.keys = volume.table.keys
    scene.numbers = cells.numbers
    scene.layers = cells.layers
    scene.neighbours = cells.neighbours
    scene.low, scene.high = cells.bounds
    scene.voxels = volume.voxels
    return scene


def _rays(volume: Volume, poses: Sequence[Matrix]) -> tuple[wp.array, wp.array, wp.array]:
    """Return the poses' origins, whole and remaining voxels, and their axes in voxels a metre."""
    checked = np.stack([rigid(pose, source="world_from_camera") for pose in poses])
    origins = checked[:, :3, 3] / volume.voxel_size
    if np.abs(origins).max() > FARTHEST:
        raise InputError(
            f"world_from_camera: the camera is {np.abs(checked[:, :3, 3]).max():g} m from the world's origin, too far"
            f" for voxels of {volume.voxel_size:g} m; expected at most {FARTHEST * volume.voxel_size:g} m"
        )
    cells = np.floor(origins)
    return (
        wp.array(cells.astype(np.int32), dtype=wp.vec3i, device=volume.device),
        wp.array((origins - cells).astype(np.float32), dtype=wp.vec3, device=volume.device),
        wp.array((checked[:, :3, :3] / volume.voxel_size).astype(np.float32), dtype=wp.mat33, device=volume.device),
    )


def cast_rays(
    volume: Volume,
    camera: PinholeCamera,
    world_from_camera: Matrix,
    *,
    depth_min: float = 0.0,
    depth_max: float = np.inf,
    min_weight: float = 0.0,
) -> RayCast:
    """See the volume's surface from a pose, one ray through each pixel's centre.

    ``depth_min``, ``depth_max`` (planar metres) bound the rays; voxels of less weight than ``min_weight`` count as
    unseen. A pixel has no surface where its ray meets none, or meets one from behind first. Raises InputError for a
    pose that is not rigid and for bounds that are none.
    """
    bounds = {"depth_min": depth_min, "depth_max": depth_max, "min_weight": min_weight}
    depth, normals, color = _cast(volume, camera, [world_from_camera], **bounds, shaded=True)
    return RayCast(depth=depth.numpy()[0], normals=normals.numpy()[0], color=color.numpy()[0])


def cast_depths(
    volume: Volume,
    camera: PinholeCamera,
    poses: Sequence[Matrix],
    *,
    depth_min: float = 0.0,
    depth_max: float = np.inf,
    min_weight: float = 0.0,
) -> wp.array:
    """See the volume's surface from many poses (world_from_camera), in depth alone, as ``cast_rays`` does from one.

    Returns (poses, height, width) float32 planar metres, 0 where there is no surface, on the volume's device.
    """
    bounds = {"depth_min": depth_min, "depth_max": depth_max, "min_weight": min_weight}
    return _cast(volume, camera, poses, **bounds, shaded=False)[0]
