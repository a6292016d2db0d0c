"""Ray casting: the surface as a camera sees it, straight from the volume.

Surface is where marching cubes has it, in cells whose eight corners were all seen, but smooth within a cell where the
mesh is flat.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import Matrix, rigid
from fusion.devices import launch_in_slabs
from fusion.surface.ray_traversal import Hit, Ray, Scene, cast_ray, corner_distances, corner_voxel
from fusion.surface.surface_cells import SurfaceCells, find_surface_cells
from fusion.volume.trilinear import trilinear_gradient
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxels import sums_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

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

    ``depth_min``, ``depth_max`` (planar metres) bound the rays; a voxel counts as seen where its weight is over
    ``min_weight``. A pixel has no surface where its ray meets none, or meets one from behind first. Raises InputError
    for a pose that is not rigid and for bounds that are none.
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
