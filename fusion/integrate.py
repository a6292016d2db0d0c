"""Frame integration: the paper's equations (1) to (5), for every voxel of the blocks that the frames see.

A frame changes a voxel where the pixel in front of it has a valid depth and d ≥ −t: farther behind the surface than the
truncation nothing was seen, and the −1 of equation (2) would claim solid space there. In front, t_d is clipped to +1.
Colour is taken where |d| ≤ t, near the surface that shows it. Each frame's weight w_new is 1, or what ``Weighting``
says.

Rows of eight voxels along x are taken through all frames of the batch that see their quarter of the block; the sums
stay in registers, so a voxel is read and written once a batch however many frames see it. Along the row the projection
moves by a constant step. The row is written in C++, the same for CPU and CUDA, because its plain loops over eight lanes
become vector instructions on the CPU, which Warp's scalar code does not: it takes half the time.
"""

from functools import cache

import warp as wp

from fusion.block_table import BLOCK_SIDE
from fusion.devices import Kernel, launch_in_slabs
from fusion.frame_batch import FrameBatch
from fusion.volume import Volume
from fusion.voxels import PACKING_IN_CPP, Voxels

_ROWS = wp.constant(BLOCK_SIDE * BLOCK_SIDE)

# Names as in the paper: d by (1), t_d by (2); (3) to (5) are sums here, and averages where the volume is read. Lanes
# without a valid pixel read pixel 0 and are masked. `left` runs through the mask's bits, the frames.
_ROW_IN_CPP = """
    constexpr int LANES = 8;
    float distances[LANES] = {0}, weights[LANES] = {0}, reds[LANES] = {0}, greens[LANES] = {0}, blues[LANES] = {0};
    float color_weights[LANES] = {0};
    const int height = depth.shape[1], width = depth.shape[2];
    const float bottom = (float)height, right = (float)width;
    for (unsigned int left = frame_mask; left != 0; left &= left - 1) {
#ifdef __CUDA_ARCH__
        const int frame = __ffs(left) - 1;
#else
        const int frame = __builtin_ctz(left);
#endif
        const wp::mat44 &p = pixel_from_lattice.data[frame];
        const float uz = p.data[0][0] * x + p.data[0][1] * y + p.data[0][2] * z + p.data[0][3];
        const float vz = p.data[1][0] * x + p.data[1][1] * y + p.data[1][2] * z + p.data[1][3];
        const float z0 = p.data[2][0] * x + p.data[2][1] * y + p.data[2][2] * z + p.data[2][3];
        const size_t image = (size_t)frame * height * width;
        float d[LANES], z_voxel[LANES];
        int seen[LANES], near[LANES], pixel[LANES], any_seen = 0, any_near = 0;
        for (int i = 0; i < LANES; ++i) {
            z_voxel[i] = z0 + i * p.data[2][0];
            const float inverse = 1.0f / z_voxel[i];
            // Shifted by half a pixel, truncation rounds to the nearest pixel centre.
            const float u = (uz + i * p.data[0][0]) * inverse + 0.5f;
            const float v = (vz + i * p.data[1][0]) * inverse + 0.5f;
            seen[i] = (z_voxel[i] > 0.0f) & (u >= 0.0f) & (v >= 0.0f) & (u < right) & (v < bottom);
            pixel[i] = seen[i] ? (int)v * width + (int)u : 0;
        }
        for (int i = 0; i < LANES; ++i) {
            const float z_pixel = depth_scale * (float)depth.data[image + pixel[i]];
            d[i] = z_pixel - z_voxel[i];
            seen[i] &= (z_pixel > 0.0f) & (d[i] >= -truncation);
            near[i] = seen[i] & (d[i] <= truncation);
            any_seen |= seen[i];
            any_near |= near[i];
        }
        if (!any_seen) continue;
        for (int i = 0; i < LANES; ++i) {
            const float ratio = d[i] / truncation;
            const float t_d = ratio < 1.0f ? ratio : 1.0f;
            distances[i] += seen[i] ? t_d : 0.0f;
            weights[i] += seen[i] ? 1.0f : 0.0f;
        }
        if (!any_near) continue;
        for (int i = 0; i < LANES; ++i) {
            const unsigned int rgb = near[i] ? color.data[image + pixel[i]] : 0u;
            reds[i] += (float)(rgb & 255u);
            greens[i] += (float)((rgb >> 8) & 255u);
            blues[i] += (float)((rgb >> 16) & 255u);
            color_weights[i] += near[i] ? 1.0f : 0.0f;
        }
    }
    const bool packed = voxels.packed.shape[0] > 0;
    for (int i = 0; packed && i < LANES; ++i) {
        if (weights[i] == 0.0f) continue;
        const unsigned long long bits = voxels.packed.data[voxel + i];
        const float weight = weight_of_bits((unsigned int)(bits >> 16) & 0xffffu);
        const float color_weight = weight * (float)(bits >> 56) * (1.0f / 255.0f);
        voxels.packed.data[voxel + i] = pack_voxel(
            voxel + i,
            distances[i] + weight * (float)(short)(bits & 0xffffu) * (1.0f / 32767.0f),
            weights[i] + weight,
            reds[i] + color_weight * (float)((bits >> 32) & 255u),
            greens[i] + color_weight * (float)((bits >> 40) & 255u),
            blues[i] + color_weight * (float)((bits >> 48) & 255u),
            color_weights[i] + color_weight);
    }
    for (int i = 0; !packed && i < LANES; ++i) {
        if (weights[i] > 0.0f) {
            voxels.distance_sum.data[voxel + i] += distances[i];
            voxels.weight.data[voxel + i] += weights[i];
            voxels.color_sum.data[voxel + i] += wp::vec3(reds[i], greens[i], blues[i]);
            voxels.color_weight.data[voxel + i] += color_weights[i];
        }
    }
"""


@cache
def _kernels(depth_type: type) -> tuple[Kernel, Kernel]:
    """Return the kernel whose threads take a block each, for the CPU, and the one whose threads take a row."""

    @wp.func_native(PACKING_IN_CPP + _ROW_IN_CPP)
    def integrate_row(
        frame_mask: wp.uint32,
        x: float,
        y: float,
        z: float,
        voxel: int,
        depth: wp.array3d(dtype=depth_type),
        depth_scale: float,
        color: wp.array3d(dtype=wp.uint32),
        pixel_from_lattice: wp.array(dtype=wp.mat44),
        truncation: float,
        voxels: Voxels,
    ) -> None:
        """Add all frames of ``frame_mask`` to the eight voxels from ``voxel`` on, at lattice position (x …, y, z)."""

    @wp.func
    def integrate(
        number: int,
        row: int,
        masks: wp.array2d(dtype=wp.uint32),
        block: wp.vec3i,
        depth: wp.array3d(dtype=depth_type),
        depth_scale: float,
        color: wp.array3d(dtype=wp.uint32),
        pixel_from_lattice: wp.array(dtype=wp.mat44),
        truncation: float,
        voxels: Voxels,
    ):
        y = row & 7
        z = row >> 3
        mask = masks[number, (y >> 2) + 2 * (z >> 2)]
        if mask != wp.uint32(0):
            integrate_row(
                mask,
                float(8 * block[0]),
                float(8 * block[1] + y),
                float(8 * block[2] + z),
                (number * _ROWS + row) * 8,
                depth,
                depth_scale,
                color,
                pixel_from_lattice,
                truncation,
                voxels,
            )

    @wp.kernel(module="unique", enable_backward=False, module_options={"max_unroll": 1})
    def integrate_blocks(
        first: int,
        masks: wp.array2d(dtype=wp.uint32),
        blocks: wp.array(dtype=wp.vec3i),
        depth: wp.array3d(dtype=depth_type),
        depth_scale: float,
        color: wp.array3d(dtype=wp.uint32),
        pixel_from_lattice: wp.array(dtype=wp.mat44),
        truncation: float,
        voxels: Voxels,
    ) -> None:
        number = wp.tid() + first
        any_frame = masks[number, 0] | masks[number, 1] | masks[number, 2] | masks[number, 3]
        if any_frame == wp.uint32(0):
            return
        for row in range(_ROWS):
            integrate(
                number, row, masks, blocks[number], depth, depth_scale, color, pixel_from_lattice, truncation, voxels
            )

    @wp.kernel(module="unique", enable_backward=False)
    def integrate_rows(
        first: int,
        masks: wp.array2d(dtype=wp.uint32),
        blocks: wp.array(dtype=wp.vec3i),
        depth: wp.array3d(dtype=depth_type),
        depth_scale: float,
        color: wp.array3d(dtype=wp.uint32),
        pixel_from_lattice: wp.array(dtype=wp.mat44),
        truncation: float,
        voxels: Voxels,
    ) -> None:
        index = wp.tid() + first
        number = index / _ROWS
        row = index - number * _ROWS
        integrate(number, row, masks, blocks[number], depth, depth_scale, color, pixel_from_lattice, truncation, voxels)

    return integrate_blocks, integrate_rows


def integrate_frames(volume: Volume, batch: FrameBatch, masks: wp.array) -> None:
    """Add a batch of frames to the volume's sums, over what they see of its blocks (``visible_blocks``)."""
    assert batch.color is not None, "integration takes frames with colour"
    by_block, by_row = _kernels(batch.depth.dtype)
    on_cuda = volume.device.is_cuda
    launch_in_slabs(
        by_row if on_cuda else by_block,
        dim=volume.table.count * (BLOCK_SIDE * BLOCK_SIDE if on_cuda else 1),
        inputs=[
            masks,
            volume.table.blocks,
            batch.depth,
            batch.depth_scale,
            batch.color,
            batch.pixel_from_lattice(volume.voxel_size),
            volume.truncation,
        ],
        outputs=[volume.voxels],
        device=volume.device,
    )
