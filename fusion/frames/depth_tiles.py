"""What the depth images hold, by 8×8 tiles: the basis on which blocks are found, and passed over.

A tile's valid depths span one range, or two where it lies across an edge in depth: its near pixels and its far ones.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from fusion.devices import Kernel, launch_in_slabs
from fusion.frames.frame_batch import FrameBatch

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

TILE = 8
NONE_NEAR = wp.constant(3.0e38)
"""Where an empty range begins."""

# All lanes first look for the extremes, in the images' own type T; only where those are far apart a second look splits
# the tile. Less one, an invalid 0 in steps becomes the largest number there is, so that no smallest one is 0.
_SURVEY_IN_CPP = """
    constexpr float FAR = 3.0e38f;
    const int height = depth.shape[1], width = depth.shape[2], columns = ranges.shape[2];
    const int v0 = 8 * tile_v, u0 = 8 * tile_u;
    const int rows = height - v0 < 8 ? height - v0 : 8, lanes = width - u0 < 8 ? width - u0 : 8;
    const T *corner = depth.data + ((size_t)frame * height + v0) * width + u0;
    const size_t tile = ((size_t)frame * ranges.shape[1] + tile_v) * columns + tile_u;
    const T none = STEPS ? (T)65535 : (T)FAR;
    T low[8], high[8];
    for (int i = 0; i < 8; ++i) { low[i] = none; high[i] = (T)0; }
    auto look = [&](int v, int i) {
        const T z = corner[(size_t)v * width + i];
        const T valid = STEPS ? (T)(z - 1) : z > (T)0 ? z : none;
        low[i] = valid < low[i] ? valid : low[i];
        high[i] = z > high[i] ? z : high[i];
    };
    if (lanes == 8) {
        for (int v = 0; v < rows; ++v) for (int i = 0; i < 8; ++i) look(v, i);
    } else {
        for (int v = 0; v < rows; ++v) for (int i = 0; i < lanes; ++i) look(v, i);
    }
    T all_low = none, all_high = (T)0;
    for (int i = 0; i < 8; ++i) {
        all_low = low[i] < all_low ? low[i] : all_low;
        all_high = high[i] > all_high ? high[i] : all_high;
    }
    const float nearest = all_low == none ? FAR : (float)all_low + (STEPS ? 1.0f : 0.0f);
    const float farthest = (float)all_high;
    float near_end = farthest, far_begin = FAR, far_end = 0.0f;
    if ((farthest - nearest) * scale > split_beyond) {
        const float middle = 0.5f * (nearest + farthest);
        near_end = 0.0f;
        far_end = farthest;
        for (int v = 0; v < rows; ++v) {
            for (int i = 0; i < lanes; ++i) {
                const float z = (float)corner[(size_t)v * width + i];
                if (z > middle) far_begin = z < far_begin ? z : far_begin;
                else if (z > 0.0f) near_end = z > near_end ? z : near_end;
            }
        }
    }
    ranges.data[tile] = wp::vec4(nearest < FAR ? nearest * scale : FAR, near_end * scale,
                                 far_begin < FAR ? far_begin * scale : FAR, far_end * scale);
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
    """Return the kernel for depth of a type, uint16 or float32; its threads take a tile each."""
    in_steps = depth_type is wp.uint16
    declared = f"typedef {'unsigned short' if in_steps else 'float'} T; constexpr bool STEPS = {str(in_steps).lower()};"

    @wp.func_native(declared + _SURVEY_IN_CPP)
    def survey_tile(
        frame: int,
        tile_v: int,
        tile_u: int,
        depth: wp.array3d(dtype=depth_type),
        scale: float,
        split_beyond: float,
        ranges: wp.array3d(dtype=wp.vec4),
    ) -> None:
        """Write a tile's ranges."""

    @wp.kernel(module="unique", enable_backward=False)
    def survey_tiles(
        first: int,
        depth: wp.array3d(dtype=depth_type),
        scale: float,
        split_beyond: float,
        ranges: wp.array3d(dtype=wp.vec4),
    ) -> None:
        index = wp.tid() + first
        columns = ranges.shape[2]
        rows = ranges.shape[1]
        tile_v = (index / columns) % rows
        survey_tile(index / (columns * rows), tile_v, index % columns, depth, scale, split_beyond, ranges)

    return survey_tiles


def depth_tiles(batch: FrameBatch, *, split_beyond: float) -> DepthTiles:
    """Survey a batch's depth images; tiles whose depths span more than ``split_beyond`` metres have two ranges."""
    camera, device = batch.camera, batch.depth.device
    shape = (len(batch), -(-camera.height // TILE), -(-camera.width // TILE))
    tiles = DepthTiles(ranges=wp.empty(shape, dtype=wp.vec4, device=device))
    launch_in_slabs(
        kernel(batch.depth.dtype),
        dim=tiles.ranges.size,
        inputs=[batch.depth, batch.depth_scale, split_beyond],
        outputs=[tiles.ranges],
        device=device,
    )
    return tiles
