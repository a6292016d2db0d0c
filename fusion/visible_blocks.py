"""Which parts of which blocks does each frame of a batch have something to say about?

A frame says nothing about a part that lies outside its view, that is hidden by more than the truncation behind all that
it sees there, or where it has no valid depth. Only such parts are passed over: leaving them out changes no voxel. Space
that a frame sees through is not passed over, so that what one frame put there by mistake is outvoted by the others.

A block is tested whole, then by quarters of 8×4×4 voxels. A test is one look into a table: for every tile, the farthest
depth within so many tiles around it.
"""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from fusion.block_table import BLOCK_SIDE
from fusion.depth_tiles import TILE, DepthTiles
from fusion.devices import launch_in_slabs
from fusion.frame_batch import FrameBatch
from fusion.volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

QUARTERS = 4
"""Quarter q of a block holds the rows with y // 4 = q & 1 and z // 4 = q >> 1."""

RADII = (1, 2, 3, 4, 6, 8, 12, 16, 24)
"""For how many tiles around each tile the farthest depth is known; each is at most twice the one before."""

_LANES = 8
_BLOCK_THREADS = 64


# One after the other, each level is the largest of four windows of the level before, moved to its corners. On CUDA a
# block of threads shares a frame's rows; on the CPU one thread has them all, and the columns become vector lanes.
_FARTHEST_IN_CPP = """
    constexpr int RADII[] = {%s};
    constexpr int LEVELS = sizeof(RADII) / sizeof(int);
    const int rows = ranges.shape[1], columns = ranges.shape[2];
    const size_t size = (size_t)rows * columns;
    const wp::vec4 *tiles = ranges.data + frame * size;
    float *level = farthest.data + frame * LEVELS * size;
#ifdef __CUDA_ARCH__
    const int begin = threadIdx.x, step = blockDim.x;
#else
    const int begin = 0, step = 1;
#endif
    for (int v = begin; v < rows; v += step) {
        for (int u = 0; u < columns; ++u) {
            float z = 0.0f;
            for (int row = v > 0 ? v - 1 : 0; row <= v + 1 && row < rows; ++row) {
                for (int column = u > 0 ? u - 1 : 0; column <= u + 1 && column < columns; ++column) {
                    const wp::vec4 &tile = tiles[row * columns + column];
                    const float tile_max = tile.c[1] > tile.c[3] ? tile.c[1] : tile.c[3];
                    z = tile_max > z ? tile_max : z;
                }
            }
            level[v * columns + u] = z;
        }
    }
    for (int l = 1; l < LEVELS; ++l, level += size) {
        const int further = RADII[l] - RADII[l - 1];
#ifdef __CUDA_ARCH__
        __syncthreads();
#endif
        for (int v = begin; v < rows; v += step) {
            const float *top = level + (v > further ? v - further : 0) * columns;
            const float *bottom = level + (v + further < rows ? v + further : rows - 1) * columns;
            float *out = level + size + v * columns;
            auto put = [&](int u, int left, int right) {
                const float one = top[left] > top[right] ? top[left] : top[right];
                const float other = bottom[left] > bottom[right] ? bottom[left] : bottom[right];
                out[u] = one > other ? one : other;
            };
            int u = 0;
            for (; u < further && u < columns; ++u) put(u, 0, u + further < columns ? u + further : columns - 1);
            for (; u + further < columns; ++u) put(u, u - further, u + further);
            for (; u < columns; ++u) put(u, u - further, columns - 1);
        }
    }
""" % ", ".join(map(str, RADII))


@wp.func_native(_FARTHEST_IN_CPP)
def farthest_around(frame: int, ranges: wp.array3d(dtype=wp.vec4), farthest: wp.array4d(dtype=float)) -> None:
    """Fill in a frame's farthest depths, by all threads of a CUDA block together."""


@wp.kernel
def _farthest_depths(
    first: int, threads: int, ranges: wp.array3d(dtype=wp.vec4), farthest: wp.array4d(dtype=float)
) -> None:
    farthest_around((wp.tid() + first) / threads, ranges, farthest)


# `views` has a column for each frame, so that lanes are frames: rows 0 to 11 the 3×4 matrix camera_from_lattice, 12 to
# 14 how far the box reaches along the camera's axes. A lane is true where the frame may see the box.
_MARK_IN_CPP = """
    constexpr int LANES = 8;
    constexpr int RADII[] = {%s};
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
            const float cx = m[i] * x + m[stride + i] * y + m[2 * stride + i] * z + m[3 * stride + i];
            const float cy = m[4 * stride + i] * x + m[5 * stride + i] * y + m[6 * stride + i] * z + m[7 * stride + i];
            const float cz = m[8 * stride + i] * x + m[9 * stride + i] * y + m[10 * stride + i] * z + m[11 * stride + i];
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
            inside[i] = (cz + hz > 0.0f) & (close | ((u[i] + reach_u >= -0.5f) & (v[i] + reach_v >= -0.5f) &
                                                     (u[i] - reach_u <= wide - 0.5f) & (v[i] - reach_v <= high - 0.5f)));
            // A box around the camera may be anywhere in the image.
            radius[i] = close ? 1e9f : radius[i];
        }
        unsigned int seen = 0;
        for (int i = 0; i < LANES; ++i) {
            if (!inside[i] || !(asked >> i & 1u)) continue;
            int level = 0;
            while (level < LEVELS && radius[i] > %d.0f * RADII[level]) ++level;
            if (level == LEVELS) { seen |= 1u << i; continue; }
            const float last_u = wide - 1.0f, last_v = high - 1.0f;
            const int tile_u = (int)(u[i] < 0.0f ? 0.0f : u[i] > last_u ? last_u : u[i]) / %d;
            const int tile_v = (int)(v[i] < 0.0f ? 0.0f : v[i] > last_v ? last_v : v[i]) / %d;
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
""" % (", ".join(map(str, RADII)), TILE, TILE, TILE)


@wp.func_native(_MARK_IN_CPP)
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


def visible_blocks(volume: Volume, batch: FrameBatch, tiles: DepthTiles) -> wp.array:
    """Return frame masks (blocks, 4) uint32: bit f of a block's quarter is set where frame f may update a voxel."""
    table, camera, device = volume.table, batch.camera, volume.device
    masks = wp.empty((table.count, QUARTERS), dtype=wp.uint32, device=device)
    launch_in_slabs(
        _mark_visible,
        dim=table.count,
        inputs=[
            table.blocks,
            wp.array(_views(batch, volume.voxel_size), dtype=float, device=device),
            wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy),
            camera.width,
            camera.height,
            volume.truncation,
            _farthest(tiles),
        ],
        outputs=[masks],
        device=device,
    )
    return masks


def _farthest(tiles: DepthTiles) -> wp.array:
    """Return (frames, radii, rows, columns): the farthest depth within each of RADII tiles around each tile."""
    ranges = tiles.ranges
    frames, rows, columns = ranges.shape
    farthest = wp.empty((frames, len(RADII), rows, columns), dtype=float, device=ranges.device)
    threads = _BLOCK_THREADS if ranges.device.is_cuda else 1
    launch_in_slabs(
        _farthest_depths,
        dim=frames * threads,
        inputs=[threads, ranges],
        outputs=[farthest],
        device=ranges.device,
        block_dim=_BLOCK_THREADS,
    )
    return farthest


def _views(batch: FrameBatch, voxel_size: float) -> NDArray[np.float32]:
    """Return (18, frames rounded up to lanes): camera_from_lattice, and how far a block and a quarter reach in it."""
    matrices = batch.lattice_matrices(voxel_size)[:, :3]
    views = np.zeros((18, -(-len(batch) // _LANES) * _LANES), dtype=np.float32)
    views[:12, : len(batch)] = matrices.reshape(len(batch), 12).T
    for row, half in ((12, (3.5, 3.5, 3.5)), (15, (3.5, 1.5, 1.5))):
        # A little more covers rounding.
        views[row : row + 3, : len(batch)] = 1.001 * np.abs(matrices[:, :, :3]).dot(half).T
    return views
