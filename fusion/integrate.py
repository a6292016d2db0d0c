"""Frame integration: the paper's equations (1) to (5), for every voxel of the found blocks.

A thread takes a row of eight voxels along x through all frames of the batch that touch its block; the sums stay in
registers, so a voxel is read and written once a batch however many frames see it. Along the row the projection moves
by a constant step, so it costs three additions a voxel.
"""

import numpy as np
import warp as wp

from fusion.block_table import BLOCK_SIDE
from fusion.devices import launch_in_slabs
from fusion.find_blocks import FoundBlocks
from fusion.frame_batch import FrameBatch
from fusion.volume import Volume

wp.set_module_options({"enable_backward": False, "fast_math": True})

_ROWS = wp.constant(BLOCK_SIDE * BLOCK_SIDE)
vec8 = wp.types.vector(length=8, dtype=float)


@wp.func
def truncated_distance(distance: float, truncation: float) -> float:
    """Equation (2): t_d = max(−1, min(1, d / t))."""
    return wp.clamp(distance / truncation, -1.0, 1.0)


@wp.kernel
def _integrate_rows(
    first: int,
    found_numbers: wp.array(dtype=int),
    found_masks: wp.array(dtype=wp.uint32),
    blocks: wp.array(dtype=wp.vec3i),
    depth: wp.array3d(dtype=float),
    color: wp.array3d(dtype=wp.uint32),
    pixel_from_voxel: wp.array(dtype=wp.mat44),
    truncation: float,
    distance_sum: wp.array(dtype=float),
    weight: wp.array(dtype=float),
    color_sum: wp.array(dtype=wp.vec3),
    color_weight: wp.array(dtype=float),
) -> None:
    index = wp.tid() + first
    found = index / _ROWS
    row = index - found * _ROWS
    number = found_numbers[found]
    mask = found_masks[found]
    block = blocks[number]
    x = float(8 * block[0])
    y = float(8 * block[1] + row % 8)
    z = float(8 * block[2] + row / 8)
    height = depth.shape[1]
    width = depth.shape[2]
    right = float(width)
    bottom = float(height)

    sums = vec8()
    weights = vec8()
    reds = vec8()
    greens = vec8()
    blues = vec8()
    color_weights = vec8()
    for frame in range(depth.shape[0]):
        if (mask >> wp.uint32(frame)) & wp.uint32(1):
            p = pixel_from_voxel[frame]
            uz = p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]
            vz = p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]
            zc = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
            for i in range(8):
                step = float(i)
                z_voxel = zc + step * p[2, 0]
                if z_voxel > 0.0:
                    inverse = 1.0 / z_voxel
                    # Shifted by half a pixel: truncation rounds to the nearest pixel centre.
                    u = (uz + step * p[0, 0]) * inverse + 0.5
                    v = (vz + step * p[1, 0]) * inverse + 0.5
                    if u >= 0.0 and v >= 0.0 and u < right and v < bottom:
                        pixel_u = int(u)
                        pixel_v = int(v)
                        z_pixel = depth[frame, pixel_v, pixel_u]
                        d = z_pixel - z_voxel
                        if z_pixel > 0.0 and d >= -truncation:
                            sums[i] += truncated_distance(d, truncation)
                            weights[i] += 1.0
                            if d <= truncation:
                                rgb = color[frame, pixel_v, pixel_u]
                                reds[i] += float(rgb & wp.uint32(255))
                                greens[i] += float((rgb >> wp.uint32(8)) & wp.uint32(255))
                                blues[i] += float((rgb >> wp.uint32(16)) & wp.uint32(255))
                                color_weights[i] += 1.0

    voxel = (number * _ROWS + row) * 8
    for i in range(8):
        if weights[i] > 0.0:
            distance_sum[voxel + i] += sums[i]
            weight[voxel + i] += weights[i]
            if color_weights[i] > 0.0:
                color_sum[voxel + i] += wp.vec3(reds[i], greens[i], blues[i])
                color_weight[voxel + i] += color_weights[i]


def integrate_blocks(volume: Volume, batch: FrameBatch, found: FoundBlocks) -> None:
    """Add a batch of frames to the volume's sums over the blocks that ``find_blocks`` found for them."""
    assert batch.color is not None, "integration takes frames with colour"
    camera = batch.camera
    pixel_from_camera = np.array(
        [[camera.fx, 0, camera.cx, 0], [0, camera.fy, camera.cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    )
    world_from_voxel = np.diag([volume.voxel_size] * 3 + [1.0])
    pixel_from_voxel = pixel_from_camera @ batch.camera_from_world.numpy().astype(np.float64) @ world_from_voxel
    launch_in_slabs(
        _integrate_rows,
        dim=len(found) * BLOCK_SIDE * BLOCK_SIDE,
        inputs=[
            found.numbers,
            found.frame_masks,
            volume.table.blocks,
            batch.depth,
            batch.color,
            wp.array(pixel_from_voxel.astype(np.float32), dtype=wp.mat44, device=volume.device),
            volume.truncation,
        ],
        outputs=[volume.distance_sum, volume.weight, volume.color_sum, volume.color_weight],
        device=volume.device,
    )
