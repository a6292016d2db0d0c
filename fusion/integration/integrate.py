"""Frame integration: the paper's equations (1) to (5), for every voxel of the blocks that the frames see.

A frame changes a voxel where the pixel in front of it has a valid depth and d ≥ −t: farther behind the surface than the
truncation nothing was seen, and the −1 of equation (2) would claim solid space there. In front, t_d is clipped to +1.
Colour is taken where |d| ≤ t, near the surface that shows it. Each frame's weight w_new is 1, or what ``Weighting``
says.

A thread takes its voxels through all frames of the batch that see their part of the block; the sums stay in registers,
so a voxel is read and written once a batch however many frames see it. On CUDA that is one voxel, so that neighbouring
threads read side by side, and share a mask. On the CPU it is a block by rows of eight voxels along x, over which the
projection moves by a constant step. Both are the same C++, in loops over lanes that the CPU's compiler turns into
vector instructions: that takes half the time of Warp's scalar code.
"""

from functools import cache

import warp as wp

from fusion.devices import Device, Kernel, launch_in_slabs
from fusion.frames.frame_batch import FrameBatch
from fusion.frames.frame_matrices import FrameMatrices
from fusion.integration.options import Integration
from fusion.integration.visible_blocks import PARTS
from fusion.volume.block_table import BLOCK_SIDE, BLOCK_VOXELS
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxels import PACKING_IN_CPP, Voxels

_ROWS = wp.constant(BLOCK_SIDE * BLOCK_SIDE)
_PARTS = wp.constant(PARTS)
_VOXELS = wp.constant(BLOCK_VOXELS)

# Names as in the paper: d by (1), t_d by (2); (3) to (5) are sums here, and averages where the volume is read. Lanes
# without a valid pixel read pixel 0 and are masked. `left` runs through the mask's bits, the frames. BILINEAR,
# WEIGHTED and DROP_OFF are constants of the compiler, so that what is not asked for costs nothing.
_LANES_IN_CPP = """
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
        const auto *depths = depth.data + image;
        const unsigned char *colors = images.color.data + 3 * image, *confidence = images.confidence.data + image;
        float u[LANES], v[LANES], d[LANES], z_voxel[LANES], z_pixel[LANES];
        int seen[LANES], near[LANES], pixel[LANES], any_seen = 0, any_near = 0;
        for (int i = 0; i < LANES; ++i) {
            z_voxel[i] = z0 + i * p.data[2][0];
            const float inverse = 1.0f / z_voxel[i];
            // Shifted by half a pixel, truncation rounds to the nearest pixel centre.
            u[i] = (uz + i * p.data[0][0]) * inverse + 0.5f;
            v[i] = (vz + i * p.data[1][0]) * inverse + 0.5f;
            seen[i] = (z_voxel[i] > 0.0f) & (u[i] >= 0.0f) & (v[i] >= 0.0f) & (u[i] < right) & (v[i] < bottom);
            pixel[i] = seen[i] ? (int)v[i] * width + (int)u[i] : 0;
        }
        for (int i = 0; i < LANES; ++i) {
            z_pixel[i] = depth_scale * (float)depths[pixel[i]];
            d[i] = z_pixel[i] - z_voxel[i];
            seen[i] &= (z_pixel[i] > 0.0f) & (d[i] >= (BILINEAR ? -2.0f : -1.0f) * rules.truncation);
            any_seen |= seen[i];
        }
        if (!any_seen) continue;
        if (BILINEAR) {
            for (int i = 0; i < LANES; ++i) {
                const float au = seen[i] ? u[i] + 0.5f : 1.0f, av = seen[i] ? v[i] + 0.5f : 1.0f;
                const int u1 = (int)au, v1 = (int)av;  // the pixel after the one before
                const float du = au - u1, dv = av - v1;
                const int left_u = u1 > 0 ? u1 - 1 : 0, right_u = u1 < width ? u1 : width - 1;
                const int upper_v = (v1 > 0 ? v1 - 1 : 0) * width, lower_v = (v1 < height ? v1 : height - 1) * width;
                const float a = (float)depths[upper_v + left_u], b = (float)depths[upper_v + right_u];
                const float c = (float)depths[lower_v + left_u], e = (float)depths[lower_v + right_u];
                const float low_ab = a < b ? a : b, low_ce = c < e ? c : e, low = low_ab < low_ce ? low_ab : low_ce;
                const float high_ab = a > b ? a : b, high_ce = c > e ? c : e;
                const float high = high_ab > high_ce ? high_ab : high_ce;
                seen[i] &= (low > 0.0f) & ((high - low) * depth_scale <= rules.truncation);
                const float inverse = (1.0f - dv) * ((1.0f - du) / a + du / b) + dv * ((1.0f - du) / c + du / e);
                z_pixel[i] = seen[i] ? depth_scale / inverse : z_pixel[i];
                d[i] = z_pixel[i] - z_voxel[i];
                seen[i] &= d[i] >= -rules.truncation;
            }
        }
        float w_new[LANES];
        for (int i = 0; i < LANES; ++i) {
            const float ratio = d[i] / rules.truncation;
            const float t_d = ratio < 1.0f ? ratio : 1.0f;
            w_new[i] = seen[i] ? (WEIGHTED ? images.pixel_weights.data[image + pixel[i]] : 1.0f) : 0.0f;
            if (DROP_OFF) w_new[i] *= ratio < 0.0f ? 1.0f + ratio : 1.0f;
            distances[i] += seen[i] ? w_new[i] * t_d : 0.0f;
            weights[i] += w_new[i];
            near[i] = seen[i] & (d[i] <= rules.truncation);
            any_near |= near[i];
        }
        if (!any_near) continue;
        for (int i = 0; i < LANES; ++i) {
            // Loaded whether near or not: a branch for each lane would cost more.
            const int at = near[i] ? pixel[i] : 0;
            // Four bytes at once, of which the first is the pixel before's: a fourth one after the last there is not.
            unsigned int rgb;
            memcpy(&rgb, colors + 3 * at - (at > 0), 4);
            rgb >>= at > 0 ? 8 : 0;
            const float w_color = near[i] ? w_new[i] * ((float)confidence[at] * (1.0f / 255.0f)) : 0.0f;
            reds[i] += w_color * (float)(rgb & 255u);
            greens[i] += w_color * (float)((rgb >> 8) & 255u);
            blues[i] += w_color * (float)((rgb >> 16) & 255u);
            color_weights[i] += w_color;
        }
    }
    // Read, add, write: as loops of their own, for the sake of vector instructions.
    float distance[LANES], weight[LANES], red[LANES], green[LANES], blue[LANES], color_weight[LANES];
    const bool packed = voxels.packed.shape[0] > 0;
    if (packed) {
        for (int i = 0; i < LANES; ++i) {
            const unsigned long long bits = voxels.packed.data[voxel + i];
            const unsigned int low = (unsigned int)bits, high = (unsigned int)(bits >> 32);
            weight[i] = weight_of_bits(low >> 16);
            distance[i] = weight[i] * (float)(short)(low & 0xffffu) * (1.0f / 32767.0f);
            color_weight[i] = weight[i] * (float)(high >> 24) * (1.0f / 255.0f);
            red[i] = color_weight[i] * (float)(high & 255u);
            green[i] = color_weight[i] * (float)((high >> 8) & 255u);
            blue[i] = color_weight[i] * (float)((high >> 16) & 255u);
        }
    } else {
        for (int i = 0; i < LANES; ++i) {
            distance[i] = voxels.distance_sum.data[voxel + i];
            weight[i] = voxels.weight.data[voxel + i];
            color_weight[i] = voxels.color_weight.data[voxel + i];
            red[i] = voxels.color_sum.data[voxel + i].c[0];
            green[i] = voxels.color_sum.data[voxel + i].c[1];
            blue[i] = voxels.color_sum.data[voxel + i].c[2];
        }
    }
    for (int i = 0; i < LANES; ++i) {
        const float sum = weight[i] + rules.sign * weights[i];
        const float color_sum = color_weight[i] + rules.sign * color_weights[i];
        // What rounding leaves of a weight that was taken away is nothing; above the cap, all sums shrink alike.
        const float capped = sum > rules.weight_cap ? rules.weight_cap / sum : 1.0f;
        const float kept = sum < 1e-4f * weight[i] ? 0.0f : capped;
        const float kept_color = color_sum < 1e-4f * color_weight[i] ? 0.0f : kept;
        weight[i] = kept * sum;
        distance[i] = kept * (distance[i] + rules.sign * distances[i]);
        color_weight[i] = kept_color * color_sum;
        red[i] = kept_color * (red[i] + rules.sign * reds[i]);
        green[i] = kept_color * (green[i] + rules.sign * greens[i]);
        blue[i] = kept_color * (blue[i] + rules.sign * blues[i]);
    }
    if (packed) {
        for (int i = 0; i < LANES; ++i) {
            const unsigned long long bits = pack_voxel(
                voxel + i, distance[i], weight[i], red[i], green[i], blue[i], color_weight[i]);
            // Untouched voxels are not rounded again.
            voxels.packed.data[voxel + i] = weights[i] != 0.0f ? bits : voxels.packed.data[voxel + i];
        }
    } else {
        for (int i = 0; i < LANES; ++i) {
            voxels.distance_sum.data[voxel + i] = distance[i];
            voxels.weight.data[voxel + i] = weight[i];
            voxels.color_weight.data[voxel + i] = color_weight[i];
            voxels.color_sum.data[voxel + i] = wp::vec3(red[i], green[i], blue[i]);
        }
    }
"""

# A block's voxels read a rectangle of each frame, row by row in an order that the CPU does not foresee. Asked for at
# once, its cache lines arrive while the first rows are worked on, and not one after the other.
_PREFETCH_IN_CPP = """
#ifndef __CUDA_ARCH__
    constexpr int DEPTHS_A_LINE = 64 / sizeof(depth.data[0]);
    const int height = depth.shape[1], width = depth.shape[2];
    for (unsigned int left = frame_mask; left != 0; left &= left - 1) {
        const int frame = __builtin_ctz(left);
        const wp::mat44 &p = pixel_from_lattice.data[frame];
        float u_min = 1e9f, u_max = -1.0f, v_min = 1e9f, v_max = -1.0f, z_min = 1e9f;
        for (int corner = 0; corner < 8; ++corner) {
            const float cx = x + 7.0f * (corner & 1), cy = y + 7.0f * (corner >> 1 & 1), cz = z + 7.0f * (corner >> 2);
            auto along = [&](int row) {
                return p.data[row][0] * cx + p.data[row][1] * cy + p.data[row][2] * cz + p.data[row][3];
            };
            const float depth_z = along(2), u = along(0) / depth_z, v = along(1) / depth_z;
            z_min = depth_z < z_min ? depth_z : z_min;
            u_min = u < u_min ? u : u_min;
            u_max = u > u_max ? u : u_max;
            v_min = v < v_min ? v : v_min;
            v_max = v > v_max ? v : v_max;
        }
        if (!(z_min > 0.0f)) continue;
        const int first_u = u_min > 0.0f ? (int)u_min : 0, last_u = u_max < width - 1.0f ? (int)u_max + 1 : width - 1;
        const int first_v = v_min > 0.0f ? (int)v_min : 0, last_v = v_max < height - 1.0f ? (int)v_max + 1 : height - 1;
        for (int v_pixel = first_v; v_pixel <= last_v; ++v_pixel) {
            const size_t line = ((size_t)frame * height + v_pixel) * width;
            for (int u = first_u / DEPTHS_A_LINE * DEPTHS_A_LINE; u <= last_u; u += DEPTHS_A_LINE)
                __builtin_prefetch(depth.data + line + u, 0, 2);
            for (size_t at = 3 * (line + first_u) / 64 * 64; at <= 3 * (line + last_u) + 2; at += 64)
                __builtin_prefetch(images.color.data + at, 0, 2);
            for (size_t at = (line + first_u) / 64 * 64; at <= line + last_u; at += 64)
                __builtin_prefetch(images.confidence.data + at, 0, 2);
        }
    }
#endif
"""


@wp.struct
class Images:
    """What the frames show besides depth.

    ``color`` (frames, height, 3 · width) RGB; ``confidence`` of the colours and ``pixel_weights`` (frames, height,
    width), the latter empty where all are 1.
    """

    color: wp.array3d(dtype=wp.uint8)
    confidence: wp.array3d(dtype=wp.uint8)
    pixel_weights: wp.array3d(dtype=float)


@wp.struct
class Rules:
    """``truncation`` metres; ``sign`` +1 to add frames, −1 to remove them; ``weight_cap`` of a voxel."""

    truncation: float
    sign: float
    weight_cap: float


@cache
def kernel(depth_type: type, *, by_voxel: bool, bilinear: bool, weighted: bool, drop_off: bool) -> Kernel:
    """Return the kernel for the given options; its threads take a voxel each (for CUDA), or a block (for the CPU)."""
    constants = {"BILINEAR": bilinear, "WEIGHTED": weighted, "DROP_OFF": drop_off}
    declared = "".join(f"constexpr bool {name} = {str(value).lower()};\n" for name, value in constants.items())
    declared += f"constexpr int LANES = {1 if by_voxel else BLOCK_SIDE};\n"

    @wp.func_native(declared + PACKING_IN_CPP + _LANES_IN_CPP)
    def integrate_lanes(
        frame_mask: wp.uint32,
        x: float,
        y: float,
        z: float,
        voxel: int,
        depth: wp.array3d(dtype=depth_type),
        depth_scale: float,
        images: Images,
        pixel_from_lattice: wp.array(dtype=wp.mat44),
        rules: Rules,
        voxels: Voxels,
    ) -> None:
        """Add all frames of ``frame_mask`` to the voxels from ``voxel`` on, at lattice position (x …, y, z)."""

    @wp.func_native(_PREFETCH_IN_CPP)
    def prefetch_block(
        frame_mask: wp.uint32,
        x: float,
        y: float,
        z: float,
        depth: wp.array3d(dtype=depth_type),
        images: Images,
        pixel_from_lattice: wp.array(dtype=wp.mat44),
    ) -> None:
        """Ask for the pixels that the block whose first voxel is (x, y, z) on the lattice projects to."""

    @wp.func
    def integrate(
        number: int,
        local: int,
        masks: wp.array2d(dtype=wp.uint32),
        blocks: wp.array(dtype=wp.vec3i),
        depth: wp.array3d(dtype=depth_type),
        depth_scale: float,
        images: Images,
        pixel_from_lattice: wp.array(dtype=wp.mat44),
        rules: Rules,
        voxels: Voxels,
    ) -> None:
        y = (local >> 3) & 7
        z = local >> 6
        mask = masks[number, (y >> 2) + 2 * (z >> 2)]
        if mask != wp.uint32(0):
            first = 8 * blocks[number]
            integrate_lanes(
                mask,
                float(first[0] + (local & 7)),
                float(first[1] + y),
                float(first[2] + z),
                number * _VOXELS + local,
                depth,
                depth_scale,
                images,
                pixel_from_lattice,
                rules,
                voxels,
            )

    @wp.kernel(module="unique", enable_backward=False, module_options={"max_unroll": 1})
    def integrate_blocks(
        first: int,
        masks: wp.array2d(dtype=wp.uint32),
        blocks: wp.array(dtype=wp.vec3i),
        depth: wp.array3d(dtype=depth_type),
        depth_scale: float,
        images: Images,
        pixel_from_lattice: wp.array(dtype=wp.mat44),
        rules: Rules,
        voxels: Voxels,
    ) -> None:
        number = wp.tid() + first
        any_frame = wp.uint32(0)
        for part in range(_PARTS):
            any_frame = any_frame | masks[number, part]
        if any_frame == wp.uint32(0):
            return
        corner = 8 * blocks[number]
        prefetch_block(
            any_frame, float(corner[0]), float(corner[1]), float(corner[2]), depth, images, pixel_from_lattice
        )
        for row in range(_ROWS):
            integrate(number, 8 * row, masks, blocks, depth, depth_scale, images, pixel_from_lattice, rules, voxels)

    @wp.kernel(module="unique", enable_backward=False)
    def integrate_voxels(
        first: int,
        masks: wp.array2d(dtype=wp.uint32),
        blocks: wp.array(dtype=wp.vec3i),
        depth: wp.array3d(dtype=depth_type),
        depth_scale: float,
        images: Images,
        pixel_from_lattice: wp.array(dtype=wp.mat44),
        rules: Rules,
        voxels: Voxels,
    ) -> None:
        index = wp.tid() + first
        number = index / _VOXELS
        local = index - number * _VOXELS
        integrate(number, local, masks, blocks, depth, depth_scale, images, pixel_from_lattice, rules, voxels)

    return integrate_voxels if by_voxel else integrate_blocks


def kernel_for(depth_type: type, device: Device, options: Integration, *, weighted: bool) -> Kernel:
    """Return the kernel that integrates with ``options``; ``weighted`` tells that pixels have weights."""
    return kernel(
        depth_type,
        by_voxel=device.is_cuda,
        bilinear=options.depth_sampling == "bilinear",
        weighted=weighted,
        drop_off=options.drop_off,
    )


def threads_a_block(device: Device) -> int:
    """Return how many threads share a block in the kernel for a device."""
    return BLOCK_VOXELS if device.is_cuda else 1


def integrate_frames(
    volume: Volume,
    batch: FrameBatch,
    matrices: FrameMatrices,
    masks: wp.array,
    options: Integration,
    *,
    remove: bool = False,
) -> None:
    """Add a batch of frames to the volume's sums, or take it away, over what they see of its blocks.

    ``masks`` (blocks, 4) come from ``visible_blocks``; blocks beyond them are left alone. Removing what was added with
    the same options leaves the sums as they were before, to rounding.
    """
    images = Images()
    assert batch.color is not None, "integration takes frames with colour"
    images.color = batch.color
    images.confidence = batch.confidence
    if batch.pixel_weights is not None:
        images.pixel_weights = batch.pixel_weights
    rules = Rules()
    rules.truncation = volume.truncation
    rules.sign = -1.0 if remove else 1.0
    rules.weight_cap = options.weight_cap or 3.0e38
    launch_in_slabs(
        kernel_for(batch.depth.dtype, volume.device, options, weighted=batch.pixel_weights is not None),
        dim=masks.shape[0] * threads_a_block(volume.device),
        inputs=[
            masks,
            volume.table.blocks,
            batch.depth,
            batch.depth_scale,
            images,
            matrices.pixel_from_lattice,
            rules,
        ],
        outputs=[volume.voxels],
        device=volume.device,
        least_slab=16,
    )
