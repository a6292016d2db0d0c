"""Where a pixel's colour cannot be trusted: next to an edge in depth it is a mixture of both sides.

A camera's pixel, and a rendered one, gathers light from around its centre, while its depth belongs to one surface. At a
silhouette the background's colour would bleed onto the object. There the colour's weight is lowered to 1 of 255: it
counts only where no other frame shows the same place better.
"""

from functools import cache

import warp as wp

from fusion.devices import Kernel, launch_in_slabs
from fusion.frames.frame_batch import TILE, FrameBatch

# A pixel is at an edge where the 3×3 pixels around it span more than the step, or one of them has no depth. On the CPU
# a thread has a row of the image, of which a piece at a time becomes vector lanes, first the columns of three and then
# three of these; on CUDA it has eight pixels, a byte.
_JUDGE_IN_CPP = """
#ifdef __CUDA_ARCH__
    constexpr int WIDE = 8;
#else
    constexpr int WIDE = 320;
#endif
    const int height = depth.shape[1], width = depth.shape[2];
    const T *here = depth.data + ((size_t)frame * height + v) * width;
    const T *above = v > 0 ? here - width : here, *below = v < height - 1 ? here + width : here;
    unsigned char *out = confidence.data + ((size_t)frame * confidence.shape[1] + v / 8) * confidence.shape[2] + v % 8;
    const int end = 8 * (tile + count) < width ? 8 * (tile + count) : width;
    for (int u0 = 8 * tile; u0 < end; u0 += WIDE) {
        T low[WIDE + 2], high[WIDE + 2];  // from the pixel before u0 to the one after the last
        unsigned char trusted[WIDE];
        auto look = [&](int i, int u) {
            const T a = above[u], b = here[u], c = below[u];
            const T low_ab = a < b ? a : b, high_ab = a > b ? a : b;
            low[i] = low_ab < c ? low_ab : c;
            high[i] = high_ab > c ? high_ab : c;
        };
        const int lanes = end - u0 < WIDE ? end - u0 : WIDE;
        look(0, u0 > 0 ? u0 - 1 : 0);
        if (lanes == WIDE) {
            for (int i = 0; i < WIDE; ++i) look(i + 1, u0 + i);
        } else {
            for (int i = 0; i < lanes; ++i) look(i + 1, u0 + i);
            for (int i = lanes; i < WIDE; ++i) low[i + 1] = high[i + 1] = (T)0;
        }
        look(lanes + 1, u0 + lanes < width ? u0 + lanes : width - 1);
        for (int i = 0; i < WIDE; ++i) {
            const T low_ab = low[i] < low[i + 1] ? low[i] : low[i + 1];
            const T lowest = low_ab < low[i + 2] ? low_ab : low[i + 2];
            const T high_ab = high[i] > high[i + 1] ? high[i] : high[i + 1];
            const T span = (high_ab > high[i + 2] ? high_ab : high[i + 2]) - lowest;
            trusted[i] = (lowest > (T)0) & (span <= step);
        }
        for (int i = 0; i < lanes; i += 8) {
            // A byte a bit: multiplied, byte i's lowest bit comes to bit 56 + i.
            unsigned long long bits;
            memcpy(&bits, trusted + i, 8);
            out[u0 + i] = (unsigned char)(bits * 0x0102040810204080ull >> 56);
        }
    }
"""


@cache
def kernel(depth_type: type) -> Kernel:
    """Return the kernel for depth of a type, uint16 or float32; its threads take ``count`` times 8 pixels of a row."""
    declared = f"typedef {'unsigned short' if depth_type is wp.uint16 else 'float'} T; const T step = (T)largest_step;"

    @wp.func_native(declared + _JUDGE_IN_CPP)
    def judge_pixels(
        frame: int,
        v: int,
        tile: int,
        count: int,
        depth: wp.array3d(dtype=depth_type),
        largest_step: float,
        confidence: wp.array3d(dtype=wp.uint8),
    ) -> None:
        """Write the confidence of a row's pixels in ``count`` tiles."""

    @wp.kernel(module="unique", enable_backward=False)
    def judge_rows(
        first: int,
        count: int,
        depth: wp.array3d(dtype=depth_type),
        largest_step: float,
        confidence: wp.array3d(dtype=wp.uint8),
    ) -> None:
        parts = confidence.shape[2] / (8 * count)
        row = (wp.tid() + first) / parts
        part = wp.tid() + first - row * parts
        judge_pixels(row / depth.shape[1], row % depth.shape[1], part * count, count, depth, largest_step, confidence)

    return judge_rows


def judge_colors(batch: FrameBatch, *, step: float) -> None:
    """Fill in ``batch.confidence``: no trust where depth changes by more than ``step`` metres or ends."""
    camera, device = batch.camera, batch.depth.device
    tiles = -(-camera.width // TILE)
    count = 1 if device.is_cuda else tiles
    launch_in_slabs(
        kernel(batch.depth.dtype),
        dim=len(batch) * camera.height * (tiles // count),
        inputs=[count, batch.depth, min(step / batch.depth_scale, 65535.0)],
        outputs=[batch.confidence],
        device=device,
    )
