"""Which parts of which blocks does each frame of a batch have something to say about?

A frame says nothing about a part that lies outside its view, that is hidden by more than the truncation behind all that
it sees there, or where it has no valid depth. Only such parts are passed over: leaving them out changes no voxel. Space
that a frame sees through is not passed over, so that what one frame put there by mistake is outvoted by the others.

A block is tested whole, then by parts of 8×4×4 voxels. A test takes a few looks into a table of the farthest depths in
squares of tiles, which cover what the part's box may project to.
"""

from collections.abc import Callable

import warp as wp

from fusion.devices import Step, launch_in_slabs
from fusion.frames.depth_tiles import DepthTiles
from fusion.frames.farthest_depths import farthest_depths
from fusion.frames.frame_batch import TILE, FrameBatch
from fusion.frames.frame_matrices import FrameMatrices
from fusion.volume.block_table import BlockTable

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

PARTS = 4
"""Part p of a block holds the rows of voxels with y // 4 = p & 1 and z // 4 = p >> 1; smaller ones gain nothing."""

_PARTS = wp.constant(PARTS)

# `views` (FrameMatrices) has a column for each frame, so that lanes are frames. A lane's bit is set where the frame may
# see the box.
_MARK_IN_CPP = """
    constexpr int LANES = 8;
    const int columns = farthest.shape[3], rows = farthest.shape[2], levels = farthest.shape[1];
    const int frames = farthest.shape[0];
    const int stride = views.shape[1];
    const float wide = (float)width, high = (float)height;
    auto see = [&](float x, float y, float z, int first, int reach_row, unsigned int asked) -> unsigned int {
        const float *m = views.data + first;
        const float *reach = m + (size_t)reach_row * stride;
        float nearest[LANES], left[LANES], right[LANES], top[LANES], bottom[LANES];
        int inside[LANES], close[LANES];
        for (int i = 0; i < LANES; ++i) {
            auto along = [&](int axis) {
                const float *row = m + 4 * axis * stride + i;
                return row[0] * x + row[stride] * y + row[2 * stride] * z + row[3 * stride];
            };
            const float cx = along(0), cy = along(1), cz = along(2);
            const float hx = reach[i], hy = reach[stride + i], hz = reach[2 * stride + i];
            nearest[i] = cz - hz;
            close[i] = nearest[i] <= 0.1f * hz;
            // |x/z - x0/z0| <= (hx + hz |x0/z0|) / (z0 - hz) for every point of the box.
            const float inverse = 1.0f / cz, slope = 1.0f / (close[i] ? 1.0f : nearest[i]);
            const float px = cx * inverse, py = cy * inverse;
            // Bilinear sampling reaches a pixel farther.
            const float reach_u = fx * (hx + hz * (px < 0.0f ? -px : px)) * slope + 1.0f;
            const float reach_v = fy * (hy + hz * (py < 0.0f ? -py : py)) * slope + 1.0f;
            const float u = fx * px + center_u, v = fy * py + center_v;
            const bool across = (u + reach_u >= -0.5f) & (u - reach_u <= wide - 0.5f);
            const bool down = (v + reach_v >= -0.5f) & (v - reach_v <= high - 0.5f);
            inside[i] = (cz + hz > 0.0f) & (close[i] | (across & down));
            left[i] = u - reach_u; right[i] = u + reach_u;
            top[i] = v - reach_v; bottom[i] = v + reach_v;
        }
        unsigned int seen = 0;
        for (int i = 0; i < LANES; ++i) {
            if (!inside[i] || !(asked >> i & 1u)) continue;
            // A box around the camera may be anywhere in the image.
            if (close[i]) { seen |= 1u << i; continue; }
            auto tile = [](float pixel, float size) {
                return (int)(pixel < 0.0f ? 0.0f : pixel > size - 1.0f ? size - 1.0f : pixel) / TILE;
            };
            const int u0 = tile(left[i], wide), u1 = tile(right[i], wide);
            const int v0 = tile(top[i], high), v1 = tile(bottom[i], high);
            const int narrow = u1 - u0 < v1 - v0 ? u1 - u0 + 1 : v1 - v0 + 1;
            int level = 0;
            while (level < levels - 1 && 2 << level <= narrow) ++level;
            const int square = 1 << level;
            const float *known = farthest.data + ((size_t)(first + i) * levels + level) * rows * columns;
            float z_max = 0.0f;
            for (int row = v0;; row += square) {
                const int v = row < v1 - square + 1 ? row : v1 - square + 1;
                for (int column = u0;; column += square) {
                    const int u = column < u1 - square + 1 ? column : u1 - square + 1;
                    const float z = known[v * columns + u];
                    z_max = z > z_max ? z : z_max;
                    if (column >= u1 - square + 1) break;
                }
                if (row >= v1 - square + 1) break;
            }
            seen |= (unsigned int)((z_max > 0.0f) & (nearest[i] <= z_max + truncation)) << i;
        }
        return seen;
    };
    unsigned int parts[PARTS] = {0};
    for (int first = 0; first < frames; first += LANES) {
        const unsigned int there = frames - first >= LANES ? 0xffu : (1u << (frames - first)) - 1u;
        const unsigned int block = see(x + 3.5f, y + 3.5f, z + 3.5f, first, 12, there);
        if (block == 0u) continue;
        for (int part = 0; part < PARTS; ++part) {
            const float part_y = y + 1.5f + 4.0f * (part & 1), part_z = z + 1.5f + 4.0f * (part >> 1);
            parts[part] |= see(x + 3.5f, part_y, part_z, first, 15, block) << first;
        }
    }
    for (int part = 0; part < PARTS; ++part) masks.data[PARTS * number + part] = parts[part];
"""


@wp.func_native(f"constexpr int TILE = {TILE}, PARTS = {PARTS};" + _MARK_IN_CPP)
def mark_parts(
    x: float,
    y: float,
    z: float,
    number: int,
    views: wp.array2d(dtype=float),
    fx: float,
    fy: float,
    center_u: float,
    center_v: float,
    width: int,
    height: int,
    truncation: float,
    farthest: wp.array4d(dtype=float),
    masks: wp.array2d(dtype=wp.uint32),
) -> None:
    """Write the frame masks of the block whose first voxel is (x, y, z) on the lattice."""


@wp.kernel
def _mark_visible(
    first: int,
    count: wp.array(dtype=int),
    problem: wp.array(dtype=int),
    blocks: wp.array(dtype=wp.vec3i),
    views: wp.array2d(dtype=float),
    intrinsics: wp.vec4,  # fx, fy, cx, cy
    width: int,
    height: int,
    truncation: float,
    farthest: wp.array4d(dtype=float),
    masks: wp.array2d(dtype=wp.uint32),
) -> None:
    number = wp.tid() + first
    passed_over = number >= count[0]
    if problem.shape[0] > 0:
        passed_over = passed_over or problem[0] != 0
    if passed_over:
        for part in range(_PARTS):
            masks[number, part] = wp.uint32(0)
        return
    block = blocks[number]
    mark_parts(
        float(8 * block[0]),
        float(8 * block[1]),
        float(8 * block[2]),
        number,
        views,
        intrinsics[0],
        intrinsics[1],
        intrinsics[2],
        intrinsics[3],
        width,
        height,
        truncation,
        farthest,
        masks,
    )


def visible_blocks(
    table: BlockTable,
    batch: FrameBatch,
    tiles: DepthTiles,
    matrices: FrameMatrices,
    *,
    truncation: float,
    blocks: int | None = None,
    problem: wp.array | None = None,
    then: Callable[[wp.array], Step] | None = None,
) -> wp.array:
    """Return frame masks (blocks, 4) uint32: bit f of a part of a block is set where frame f may update a voxel.

    ``truncation`` is metres. Masks are made for the first ``blocks`` blocks, as many as the host knows of if not given;
    more than there are get 0, and all where ``problem[0]``, on the device, is not 0. ``then`` tells what follows for
    each block once its masks are there.
    """
    camera, device = batch.camera, table.device
    count = table.count if blocks is None else blocks
    masks = wp.empty((count, PARTS), dtype=wp.uint32, device=device)
    launch_in_slabs(
        _mark_visible,
        dim=count,
        inputs=[
            table.arrays.count,
            wp.empty(0, dtype=int, device=device) if problem is None else problem,
            table.blocks,
            matrices.views,
            wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy),
            camera.width,
            camera.height,
            truncation,
            farthest_depths(tiles),
        ],
        outputs=[masks],
        device=device,
        least_slab=16,
        then=then(masks) if then else None,
    )
    return masks
