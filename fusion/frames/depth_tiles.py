"""What the depth images hold, by 8×8 tiles: the basis on which blocks are found, and passed over.

A tile's valid depths span one range, or two where it lies across an edge in depth: its near pixels and its far ones.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from fusion.devices import Kernel, launch_in_slabs
from fusion.frames.frame_batch import TILE, FrameBatch

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

NONE_NEAR = wp.constant(3.0e38)
"""Where an empty range begins."""

# All lanes first look for the extremes, in the images' own type T; only where those are far apart a second look splits
# the tile. Less one, an invalid 0 in steps becomes the largest number there is, so that no smallest one is 0. On the
# CPU four tiles fill the vectors; on CUDA a thread has one.
_SURVEY_IN_CPP = """
    constexpr float FAR = 3.0e38f;
#ifdef __CUDA_ARCH__
    constexpr int WIDE = 8;
#else
    constexpr int WIDE = 32;
#endif
    const int height = depth.shape[1], width = depth.shape[2];
    const int v0 = 8 * tile_v, rows = height - v0 < 8 ? height - v0 : 8;
    const int end = 8 * (tile_u + count) < width ? 8 * (tile_u + count) : width;
    const T none = STEPS ? (T)65535 : (T)FAR;
    auto smallest = [&](const T *of) { T m = none; for (int i = 0; i < 8; ++i) m = of[i] < m ? of[i] : m; return m; };
    auto largest = [](const T *of) { T m = (T)0; for (int i = 0; i < 8; ++i) m = of[i] > m ? of[i] : m; return m; };
    for (int u0 = 8 * tile_u; u0 < end; u0 += WIDE) {
        const T *corner = depth.data + ((size_t)frame * height + v0) * width + u0;
        const int lanes = end - u0 < WIDE ? end - u0 : WIDE;
        T low[WIDE], high[WIDE];
        for (int i = 0; i < WIDE; ++i) { low[i] = none; high[i] = (T)0; }
        auto look = [&](int v, int i) {
            const T z = corner[(size_t)v * width + i];
            const T valid = STEPS ? (T)(z - 1) : z > (T)0 ? z : none;
            low[i] = valid < low[i] ? valid : low[i];
            high[i] = z > high[i] ? z : high[i];
        };
        if (lanes == WIDE) {
            for (int v = 0; v < rows; ++v) for (int i = 0; i < WIDE; ++i) look(v, i);
        } else {
            for (int v = 0; v < rows; ++v) for (int i = 0; i < lanes; ++i) look(v, i);
        }
        for (int first = 0; first < lanes; first += 8) {
            const T lowest = smallest(low + first), highest = largest(high + first);
            const float nearest = lowest == none ? FAR : (float)lowest + (STEPS ? 1.0f : 0.0f);
            const float farthest = (float)highest;
            float near_end = farthest, far_begin = FAR, far_end = 0.0f;
            if ((farthest - nearest) * scale > split_beyond) {
                const T middle = (T)(0.5f * (nearest + farthest));
                const int columns = lanes - first < 8 ? lanes - first : 8;
                T near_high[8], far_low[8];
                for (int i = 0; i < 8; ++i) { near_high[i] = (T)0; far_low[i] = none; }
                auto divide = [&](int v, int i) {
                    const T z = corner[(size_t)v * width + first + i];
                    const T if_near = z > middle ? (T)0 : z, if_far = z > middle ? z : none;
                    near_high[i] = if_near > near_high[i] ? if_near : near_high[i];
                    far_low[i] = if_far < far_low[i] ? if_far : far_low[i];
                };
                if (columns == 8) {
                    for (int v = 0; v < rows; ++v) for (int i = 0; i < 8; ++i) divide(v, i);
                } else {
                    for (int v = 0; v < rows; ++v) for (int i = 0; i < columns; ++i) divide(v, i);
                }
                near_end = (float)largest(near_high);
                far_begin = (float)smallest(far_low);
                far_end = farthest;
            }
            const size_t tile = ((size_t)frame * ranges.shape[1] + tile_v) * ranges.shape[2] + (u0 + first) / 8;
            ranges.data[tile] = wp::vec4(nearest < FAR ? nearest * scale : FAR, near_end * scale,
                                         far_begin < FAR ? far_begin * scale : FAR, far_end * scale);
        }
    }
"""


@dataclass(frozen=True, kw_only=True)
class DepthTiles:
    """Depth ranges of a batch's tiles, metres.

    ``ranges`` (frames, rows, columns) vec4: the nearest and farthest of the near pixels, then of the far pixels; an
    empty range begins at NONE_NEAR and ends at 0.
    """

    ranges: wp.array


@cache
def kernel(depth_type: type) -> Kernel:
    """Return the kernel for depth of a type, uint16 or float32; its threads take ``count`` tiles of a row each."""
    in_steps = depth_type is wp.uint16
    declared = f"typedef {'unsigned short' if in_steps else 'float'} T; constexpr bool STEPS = {str(in_steps).lower()};"

    @wp.func_native(declared + _SURVEY_IN_CPP)
    def survey_tiles_of_row(
        frame: int,
        tile_v: int,
        tile_u: int,
        count: int,
        depth: wp.array3d(dtype=depth_type),
        scale: float,
        split_beyond: float,
        ranges: wp.array3d(dtype=wp.vec4),
    ) -> None:
        """Write the ranges of ``count`` tiles."""

    @wp.kernel(module="unique", enable_backward=False)
    def survey_tiles(
        first: int,
        count: int,
        depth: wp.array3d(dtype=depth_type),
        scale: float,
        split_beyond: float,
        ranges: wp.array3d(dtype=wp.vec4),
    ) -> None:
        index = (wp.tid() + first) * count
        columns = ranges.shape[2]
        row = index / columns
        tile_u = index - row * columns
        frame = row / ranges.shape[1]
        survey_tiles_of_row(frame, row - frame * ranges.shape[1], tile_u, count, depth, scale, split_beyond, ranges)

    return survey_tiles


def depth_tiles(batch: FrameBatch, *, split_beyond: float) -> DepthTiles:
    """Survey a batch's depth images; tiles whose depths span more than ``split_beyond`` metres have two ranges."""
    camera, device = batch.camera, batch.depth.device
    shape = (len(batch), -(-camera.height // TILE), -(-camera.width // TILE))
    tiles = DepthTiles(ranges=wp.empty(shape, dtype=wp.vec4, device=device))
    count = 1 if device.is_cuda else shape[2]
    launch_in_slabs(
        kernel(batch.depth.dtype),
        dim=tiles.ranges.size // count,
        inputs=[count, batch.depth, batch.depth_scale, split_beyond],
        outputs=[tiles.ranges],
        device=device,
    )
    return tiles
