"""The farthest depth around every tile, within several distances: one look tells what a box may be hidden behind."""

import warp as wp

from fusion.depth_tiles import DepthTiles
from fusion.devices import launch_in_slabs

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

RADII = (1, 2, 3, 4, 6, 8, 12, 16, 24)
"""For how many tiles around each tile the farthest depth is known; each is at most twice the one before."""

RADII_IN_CPP = f"constexpr int RADII[] = {{{', '.join(map(str, RADII))}}};"
_BLOCK_THREADS = 64

# One after the other, each level is the largest of four windows of the level before, moved to its corners. On CUDA a
# block of threads shares a frame's rows; on the CPU one thread has them all, and the columns become vector lanes.
_FARTHEST_IN_CPP = """
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
"""


@wp.func_native(RADII_IN_CPP + _FARTHEST_IN_CPP)
def farthest_around(frame: int, ranges: wp.array3d(dtype=wp.vec4), farthest: wp.array4d(dtype=float)) -> None:
    """Fill in a frame's farthest depths, by all threads of a CUDA block together."""


@wp.kernel
def _fill_in(first: int, threads: int, ranges: wp.array3d(dtype=wp.vec4), farthest: wp.array4d(dtype=float)) -> None:
    farthest_around((wp.tid() + first) / threads, ranges, farthest)


def farthest_depths(tiles: DepthTiles) -> wp.array:
    """Return (frames, radii, rows, columns): the farthest depth within each of RADII tiles around each tile."""
    ranges = tiles.ranges
    frames, rows, columns = ranges.shape
    farthest = wp.empty((frames, len(RADII), rows, columns), dtype=float, device=ranges.device)
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
