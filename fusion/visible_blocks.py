"""Which parts of which blocks does each frame of a batch have something to say about?

A frame says nothing about a part that lies outside its view, that is hidden by more than the truncation behind all that
it sees there, or where it has no valid depth. Only such parts are passed over: leaving them out changes no voxel. Space
that a frame sees through is not passed over, so that what one frame put there by mistake is outvoted by the others.

A block is tested whole, then by quarters of 8×4×4 voxels. A test is one look into a table: for every tile, the farthest
depth within so many tiles around it.
"""

import warp as wp

from fusion.block_table import BlockTable
from fusion.depth_tiles import TILE, DepthTiles
from fusion.devices import launch_in_slabs
from fusion.farthest_depths import RADII_IN_CPP, farthest_depths
from fusion.frame_batch import FrameBatch
from fusion.frame_matrices import FrameMatrices

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

QUARTERS = 4
"""Quarter q of a block holds the rows with y // 4 = q & 1 and z // 4 = q >> 1."""

# `views` (FrameMatrices) has a column for each frame, so that lanes are frames. A lane's bit is set where the frame may
# see the box.
_MARK_IN_CPP = """
    constexpr int LANES = 8;
    constexpr int LEVELS = sizeof(RADII) / sizeof(int);
    const int columns = farthest.shape[3], rows = farthest.shape[2], frames = farthest.shape[0];
    const int stride = views.shape[1];
    const float wide = (float)width, high = (float)height;
    auto see = [&](float x, float y, float z, int first, int reach_row, unsigned int asked) -> unsigned int {
        const float *m = views.data + first;
        const float *reach = m + (size_t)reach_row * stride;
        float nearest[LANES], u[LANES], v[LANES], radius[LANES];
        int inside[LANES];
        for (int i = 0; i < LANES; ++i) {
            auto along = [&](int axis) {
                const float *row = m + 4 * axis * stride + i;
                return row[0] * x + row[stride] * y + row[2 * stride] * z + row[3 * stride];
            };
            const float cx = along(0), cy = along(1), cz = along(2);
            const float hx = reach[i], hy = reach[stride + i], hz = reach[2 * stride + i];
            nearest[i] = cz - hz;
            // |x/z - x0/z0| <= (hx + hz |x0/z0|) / (z0 - hz) for every point of the box.
            const float inverse = 1.0f / cz, slope = 1.0f / (nearest[i] > 1e-6f ? nearest[i] : 1e-6f);
            const float px = cx * inverse, py = cy * inverse;
            const float reach_u = fx * (hx + hz * (px < 0.0f ? -px : px)) * slope + 1.0f;
            const float reach_v = fy * (hy + hz * (py < 0.0f ? -py : py)) * slope + 1.0f;
            u[i] = fx * px + center_u;
            v[i] = fy * py + center_v;
            radius[i] = reach_u > reach_v ? reach_u : reach_v;
            const bool close = nearest[i] <= 0.1f * hz;
            const bool across = (u[i] + reach_u >= -0.5f) & (u[i] - reach_u <= wide - 0.5f);
            const bool down = (v[i] + reach_v >= -0.5f) & (v[i] - reach_v <= high - 0.5f);
            inside[i] = (cz + hz > 0.0f) & (close | (across & down));
            // A box around the camera may be anywhere in the image.
            radius[i] = close ? 1e9f : radius[i];
        }
        unsigned int seen = 0;
        for (int i = 0; i < LANES; ++i) {
            if (!inside[i] || !(asked >> i & 1u)) continue;
            int level = 0;
            while (level < LEVELS && radius[i] > (float)(TILE * RADII[level])) ++level;
            if (level == LEVELS) { seen |= 1u << i; continue; }
            const float last_u = wide - 1.0f, last_v = high - 1.0f;
            const int tile_u = (int)(u[i] < 0.0f ? 0.0f : u[i] > last_u ? last_u : u[i]) / TILE;
            const int tile_v = (int)(v[i] < 0.0f ? 0.0f : v[i] > last_v ? last_v : v[i]) / TILE;
            const float z = farthest.data[(((size_t)(first + i) * LEVELS + level) * rows + tile_v) * columns + tile_u];
            seen |= (unsigned int)((z > 0.0f) & (nearest[i] <= z + truncation)) << i;
        }
        return seen;
    };
    unsigned int quarters[4] = {0, 0, 0, 0};
    for (int first = 0; first < frames; first += LANES) {
        const unsigned int there = frames - first >= LANES ? 0xffu : (1u << (frames - first)) - 1u;
        const unsigned int block = see(x + 3.5f, y + 3.5f, z + 3.5f, first, 12, there);
        if (block == 0u) continue;
        for (int q = 0; q < 4; ++q) {
            const float quarter_y = y + 1.5f + 4.0f * (q & 1), quarter_z = z + 1.5f + 4.0f * (q >> 1);
            quarters[q] |= see(x + 3.5f, quarter_y, quarter_z, first, 15, block) << first;
        }
    }
    for (int q = 0; q < 4; ++q) masks.data[4 * number + q] = quarters[q];
"""


@wp.func_native(RADII_IN_CPP + f"constexpr int TILE = {TILE};" + _MARK_IN_CPP)
def mark_quarters(
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
    if number >= count[0]:
        for quarter in range(4):
            masks[number, quarter] = wp.uint32(0)
        return
    block = blocks[number]
    mark_quarters(
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
) -> wp.array:
    """Return frame masks (blocks, 4) uint32: bit f of a block's quarter is set where frame f may update a voxel.

    ``truncation`` is metres. Masks are made for the first ``blocks`` blocks, as many as the host knows of if not given;
    more than there are get 0.
    """
    camera, device = batch.camera, table.device
    count = table.count if blocks is None else blocks
    masks = wp.empty((count, QUARTERS), dtype=wp.uint32, device=device)
    launch_in_slabs(
        _mark_visible,
        dim=count,
        inputs=[
            table.arrays.count,
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
        least_slab=64,
    )
    return masks
