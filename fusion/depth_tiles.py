"""What the depth images hold, by 8×8 tiles: the basis on which blocks are found, and passed over.

A tile's valid depths span one range, or two where it lies across an edge in depth: its near pixels and its far ones.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from fusion.devices import Kernel, launch_in_slabs
from fusion.frame_batch import FrameBatch

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

TILE = 8
_TILE = wp.constant(TILE)
NONE_NEAR = wp.constant(3.0e38)
"""Where an empty range begins."""

# All lanes first look for the extremes; only where those are far apart a second look splits the tile. Depths that are
# not finite compare false, or exceed the bound, and so are passed over.
_RANGES_IN_CPP = """
    constexpr float FAR = 3.0e38f;
    const int height = depth.shape[1], width = depth.shape[2];
    const int rows = height - v0 < 8 ? height - v0 : 8, columns = width - u0 < 8 ? width - u0 : 8;
    const auto *corner = depth.data + ((size_t)frame * height + v0) * width + u0;
    float low[8], high[8];
    for (int i = 0; i < 8; ++i) { low[i] = FAR; high[i] = 0.0f; }
    if (columns == 8) {
        for (int v = 0; v < rows; ++v) {
            for (int i = 0; i < 8; ++i) {
                const float z = (float)corner[(size_t)v * width + i];
                low[i] = ((z > 0.0f) & (z < low[i])) ? z : low[i];
                high[i] = ((z > high[i]) & (z < FAR)) ? z : high[i];
            }
        }
    } else {
        for (int v = 0; v < rows; ++v) {
            for (int i = 0; i < columns; ++i) {
                const float z = (float)corner[(size_t)v * width + i];
                low[i] = ((z > 0.0f) & (z < low[i])) ? z : low[i];
                high[i] = ((z > high[i]) & (z < FAR)) ? z : high[i];
            }
        }
    }
    float nearest = FAR, farthest = 0.0f;
    for (int i = 0; i < 8; ++i) {
        nearest = low[i] < nearest ? low[i] : nearest;
        farthest = high[i] > farthest ? high[i] : farthest;
    }
    if (farthest == 0.0f) return wp::vec4(FAR, 0.0f, FAR, 0.0f);
    if ((farthest - nearest) * scale <= split_beyond) return wp::vec4(nearest * scale, farthest * scale, FAR, 0.0f);
    const float middle = 0.5f * (nearest + farthest);
    float near_end = 0.0f, far_begin = FAR;
    for (int v = 0; v < rows; ++v) {
        for (int i = 0; i < columns; ++i) {
            const float z = (float)corner[(size_t)v * width + i];
            if (z > middle) far_begin = z < far_begin ? z : far_begin;
            else if (z > 0.0f) near_end = z > near_end ? z : near_end;
        }
    }
    return wp::vec4(nearest * scale, near_end * scale, far_begin * scale, farthest * scale);
"""


@dataclass(frozen=True, kw_only=True)
class DepthTiles:
    """Depth ranges of a batch's tiles, metres.

    ``ranges`` (frames, rows, columns) vec4: the nearest and farthest of the near pixels, then of the far pixels; an
    empty range begins at NONE_NEAR and ends at 0.
    """

    ranges: wp.array


@cache
def _kernel(depth_type: type) -> Kernel:
    @wp.func_native(_RANGES_IN_CPP)
    def tile_ranges(
        depth: wp.array3d(dtype=depth_type), frame: int, v0: int, u0: int, scale: float, split_beyond: float
    ) -> wp.vec4: ...

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
        u = index % columns
        v = (index / columns) % rows
        frame = index / (columns * rows)
        ranges[frame, v, u] = tile_ranges(depth, frame, v * _TILE, u * _TILE, scale, split_beyond)

    return survey_tiles


def depth_tiles(batch: FrameBatch, *, split_beyond: float) -> DepthTiles:
    """Survey a batch's depth images; tiles whose depths span more than ``split_beyond`` metres have two ranges."""
    camera, device = batch.camera, batch.depth.device
    shape = (len(batch), -(-camera.height // TILE), -(-camera.width // TILE))
    ranges = wp.empty(shape, dtype=wp.vec4, device=device)
    launch_in_slabs(
        _kernel(batch.depth.dtype),
        dim=ranges.size,
        inputs=[batch.depth, batch.depth_scale, split_beyond],
        outputs=[ranges],
        device=device,
    )
    return DepthTiles(ranges=ranges)
