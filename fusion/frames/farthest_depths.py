"""The farthest depth in squares of tiles, so that that of any rectangle is known after a few looks (a sparse table)."""

import warp as wp

from fusion.devices import launch_in_slabs
from fusion.frames.depth_tiles import DepthTiles

_BLOCK_THREADS = 64
# Said here too, or loading the module ahead would make it for blocks that it is not launched with.
wp.set_module_options({"enable_backward": False, "max_unroll": 1, "block_dim": _BLOCK_THREADS})

LEVELS = 6
"""Level l has squares of 2^l tiles."""

_LEVELS = wp.constant(LEVELS)

# A square is the largest of four of the level before. On CUDA a block of threads shares a frame's rows; on the CPU one
# thread has them all, and the columns become vector lanes.
_FARTHEST_IN_CPP = """
    const int rows = ranges.shape[1], columns = ranges.shape[2];
    const size_t size = (size_t)rows * columns;
    const wp::vec4 *tiles = ranges.data + frame * size;
    float *level = farthest.data + frame * levels * size;
#ifdef __CUDA_ARCH__
    const int begin = threadIdx.x, step = blockDim.x;
#else
    const int begin = 0, step = 1;
#endif
    for (int v = begin; v < rows; v += step) {
        for (int u = 0; u < columns; ++u) {
            const wp::vec4 &tile = tiles[v * columns + u];
            level[v * columns + u] = tile.c[1] > tile.c[3] ? tile.c[1] : tile.c[3];
        }
    }
    for (int half = 1; half < 1 << (levels - 1); half *= 2, level += size) {
#ifdef __CUDA_ARCH__
        __syncthreads();
#endif
        for (int v = begin; v < rows; v += step) {
            // A square that would reach beyond the image ends with its last row and column.
            const float *top = level + v * columns;
            const float *bottom = level + (v + half < rows ? v + half : rows - 1) * columns;
            float *out = level + size + v * columns;
            auto put = [&](int u, int right) {
                const float one = top[u] > top[right] ? top[u] : top[right];
                const float other = bottom[u] > bottom[right] ? bottom[u] : bottom[right];
                out[u] = one > other ? one : other;
            };
            int u = 0;
            for (; u + half < columns; ++u) put(u, u + half);
            for (; u < columns; ++u) put(u, columns - 1);
        }
    }
"""


@wp.func_native(_FARTHEST_IN_CPP)
def fill_levels(frame: int, levels: int, ranges: wp.array3d(dtype=wp.vec4), farthest: wp.array4d(dtype=float)) -> None:
    """Fill in a frame's farthest depths, by all threads of a CUDA block together."""


@wp.kernel
def _fill_in(first: int, threads: int, ranges: wp.array3d(dtype=wp.vec4), farthest: wp.array4d(dtype=float)) -> None:
    fill_levels((wp.tid() + first) / threads, _LEVELS, ranges, farthest)


def farthest_depths(tiles: DepthTiles) -> wp.array:
    """Return (frames, levels, rows, columns): the farthest depth in the square that begins at each tile, metres.

    The squares of level l are 2^l tiles wide, or end with the image. Where nothing is valid it is 0.
    """
    ranges = tiles.ranges
    frames, rows, columns = ranges.shape
    farthest = wp.empty((frames, LEVELS, rows, columns), dtype=float, device=ranges.device)
    threads = _BLOCK_THREADS if ranges.device.is_cuda else 1
    launch_in_slabs(
        _fill_in,
        dim=frames * threads,
        inputs=[threads, ranges],
        outputs=[farthest],
        device=ranges.device,
        block_dim=_BLOCK_THREADS,
    )
    return farthest
