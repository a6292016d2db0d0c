"""What the kernels need of a batch's poses, computed on the device, so that nothing has to come from the host."""

from dataclasses import dataclass

import warp as wp

from fusion.frames.frame_batch import FrameBatch

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

LANES = 8
"""``views`` has columns for a multiple of this many frames."""

_HALF_BLOCK = wp.constant(wp.vec3(3.5, 3.5, 3.5))
_HALF_PART = wp.constant(wp.vec3(3.5, 1.5, 1.5))


@dataclass(frozen=True, kw_only=True)
class FrameMatrices:
    """Matrices of a batch's frames; lattice coordinates are voxel numbers, i of voxel i.

    ``world_from_camera`` (frames,) mat44; ``pixel_from_lattice`` (frames,) mat44 to (u·z, v·z, z, 1); ``views``
    (18, frames rounded up), a column a frame: the 3×4 matrix camera_from_lattice row by row, then how far the box
    around a block's voxel centres reaches along the camera's axes, then that around a part's, metres.
    """

    world_from_camera: wp.array
    pixel_from_lattice: wp.array
    views: wp.array


@wp.func
def reach(row: wp.vec3, half: wp.vec3) -> float:
    """Return how far a box extends along an axis, a little more against rounding."""
    return 1.001 * (wp.abs(row[0]) * half[0] + wp.abs(row[1]) * half[1] + wp.abs(row[2]) * half[2])


@wp.kernel
def _fill_in(
    camera_from_world: wp.array(dtype=wp.mat44d),
    intrinsics: wp.vec4d,  # fx, fy, cx, cy
    voxel_size: wp.float64,
    world_from_camera: wp.array(dtype=wp.mat44),
    pixel_from_lattice: wp.array(dtype=wp.mat44),
    views: wp.array2d(dtype=float),
) -> None:
    # In double precision; only the products are rounded.
    frame = wp.tid()
    pose = camera_from_world[frame]
    inverted = wp.inverse(pose)
    one = wp.float64(1.0)
    lattice = wp.matrix_from_rows(
        wp.vec4d(voxel_size * pose[0, 0], voxel_size * pose[0, 1], voxel_size * pose[0, 2], pose[0, 3]),
        wp.vec4d(voxel_size * pose[1, 0], voxel_size * pose[1, 1], voxel_size * pose[1, 2], pose[1, 3]),
        wp.vec4d(voxel_size * pose[2, 0], voxel_size * pose[2, 1], voxel_size * pose[2, 2], pose[2, 3]),
        wp.vec4d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), one),
    )
    world = wp.mat44()
    pixel = wp.mat44()
    for column in range(4):
        z = lattice[2, column]
        pixel[0, column] = float(intrinsics[0] * lattice[0, column] + intrinsics[2] * z)
        pixel[1, column] = float(intrinsics[1] * lattice[1, column] + intrinsics[3] * z)
        pixel[2, column] = float(z)
        pixel[3, column] = float(lattice[3, column])
        for row in range(4):
            world[row, column] = float(inverted[row, column])
        for row in range(3):
            views[4 * row + column, frame] = float(lattice[row, column])
    world_from_camera[frame] = world
    pixel_from_lattice[frame] = pixel
    for row in range(3):
        axis = wp.vec3(float(lattice[row, 0]), float(lattice[row, 1]), float(lattice[row, 2]))
        views[12 + row, frame] = reach(axis, _HALF_BLOCK)
        views[15 + row, frame] = reach(axis, _HALF_PART)


def frame_matrices(batch: FrameBatch, voxel_size: float) -> FrameMatrices:
    """Return the matrices of a batch for voxels of ``voxel_size`` metres."""
    camera, device, frames = batch.camera, batch.depth.device, len(batch)
    matrices = FrameMatrices(
        world_from_camera=wp.empty(frames, dtype=wp.mat44, device=device),
        pixel_from_lattice=wp.empty(frames, dtype=wp.mat44, device=device),
        views=wp.zeros((18, -(-frames // LANES) * LANES), dtype=float, device=device),
    )
    wp.launch(
        _fill_in,
        dim=frames,
        inputs=[batch.camera_from_world, wp.vec4d(camera.fx, camera.fy, camera.cx, camera.cy), voxel_size],
        outputs=[matrices.world_from_camera, matrices.pixel_from_lattice, matrices.views],
        device=device,
    )
    return matrices
