"""Where a pixel's colour cannot be trusted: next to an edge in depth it is a mixture of both sides.

A camera's pixel, and a rendered one, gathers light from around its centre, while its depth belongs to one surface. At a
silhouette the background's colour would bleed onto the object. There the colour's confidence is lowered to 1 of 255:
it counts only where no other frame shows the same place better.
"""

from functools import cache

import warp as wp

from fusion.depth_tiles import DepthTiles
from fusion.devices import Kernel, launch_in_slabs
from fusion.frame_batch import FrameBatch

# Most tiles lie in a neighbourhood without an edge, which their ranges tell. In the others a pixel is an edge where the
# 3×3 pixels around it span more than the step, or one of them has no depth.
_LOWER_IN_CPP = """
    const int rows = ranges.shape[1], columns = ranges.shape[2];
    const int height = depth.shape[1], width = depth.shape[2];
    const size_t first_tile = (size_t)frame * rows * columns;
    float nearest = 3.0e38f, farthest = 0.0f;
    bool all_valid = true;
    for (int v = tile_v > 0 ? tile_v - 1 : 0; v <= tile_v + 1 && v < rows; ++v) {
        for (int u = tile_u > 0 ? tile_u - 1 : 0; u <= tile_u + 1 && u < columns; ++u) {
            const wp::vec4 &range = ranges.data[first_tile + v * columns + u];
            nearest = range.c[0] < nearest ? range.c[0] : nearest;
            farthest = range.c[1] > farthest ? range.c[1] : farthest;
            farthest = range.c[3] > farthest ? range.c[3] : farthest;
            all_valid &= whole.data[first_tile + v * columns + u] != 0;
        }
    }
    if (farthest == 0.0f || (all_valid && farthest - nearest <= step)) return;
    const size_t image = (size_t)frame * height * width;
    const auto *depths = depth.data + image;
    const int v_end = height - 8 * tile_v < 8 ? height : 8 * tile_v + 8;
    const int u0 = 8 * tile_u, lanes = width - u0 < 8 ? width - u0 : 8;
    const bool inner = u0 > 0 && u0 + 8 < width;
    for (int v = 8 * tile_v; v < v_end; ++v) {
        float low[8], high[8];
        for (int i = 0; i < 8; ++i) { low[i] = 3.0e38f; high[i] = 0.0f; }
        for (int row = v > 0 ? v - 1 : 0; row <= v + 1 && row < height; ++row) {
            const auto *line = depths + (size_t)row * width;
            for (int du = -1; du <= 1; ++du) {
                if (inner) {
                    for (int i = 0; i < 8; ++i) {
                        const float z = (float)line[u0 + i + du];
                        low[i] = z < low[i] ? z : low[i];
                        high[i] = z > high[i] ? z : high[i];
                    }
                } else {
                    for (int i = 0; i < lanes; ++i) {
                        const int u = u0 + i + du;
                        const float z = (float)line[u < 0 ? 0 : u < width ? u : width - 1];
                        low[i] = z < low[i] ? z : low[i];
                        high[i] = z > high[i] ? z : high[i];
                    }
                }
            }
        }
        unsigned int *pixels = color.data + image + (size_t)v * width + u0;
        for (int i = 0; i < lanes; ++i) {
            const bool edge = !(low[i] > 0.0f) | !((high[i] - low[i]) * scale <= step);
            pixels[i] = edge ? (pixels[i] & 0x00ffffffu) | 0x01000000u : pixels[i];
        }
    }
"""


@cache
def kernel(depth_type: type) -> Kernel:
    """Return the kernel for depth of a type, uint16 or float32; its threads take a tile each."""

    @wp.func_native(_LOWER_IN_CPP)
    def lower_at_edges(
        frame: int,
        tile_v: int,
        tile_u: int,
        depth: wp.array3d(dtype=depth_type),
        scale: float,
        step: float,
        ranges: wp.array3d(dtype=wp.vec4),
        whole: wp.array3d(dtype=wp.uint8),
        color: wp.array3d(dtype=wp.uint32),
    ) -> None:
        """Lower the confidence of a tile's pixels at edges."""

    @wp.kernel(module="unique", enable_backward=False)
    def lower_confidence(
        first: int,
        depth: wp.array3d(dtype=depth_type),
        scale: float,
        step: float,
        ranges: wp.array3d(dtype=wp.vec4),
        whole: wp.array3d(dtype=wp.uint8),
        color: wp.array3d(dtype=wp.uint32),
    ) -> None:
        index = wp.tid() + first
        columns = ranges.shape[2]
        rows = ranges.shape[1]
        tile_v = (index / columns) % rows
        lower_at_edges(index / (columns * rows), tile_v, index % columns, depth, scale, step, ranges, whole, color)

    return lower_confidence


def lower_confidence_at_edges(batch: FrameBatch, tiles: DepthTiles, *, step: float) -> None:
    """Lower the confidence of a batch's colours, in place, where depth changes by more than ``step`` metres or ends."""
    launch_in_slabs(
        kernel(batch.depth.dtype),
        dim=tiles.ranges.size,
        inputs=[batch.depth, batch.depth_scale, step, tiles.ranges, tiles.whole],
        outputs=[batch.color],
        device=batch.depth.device,
    )
