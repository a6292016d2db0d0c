"""Where a pixel's colour cannot be trusted: next to an edge in depth it is a mixture of both sides.

A camera's pixel, and a rendered one, gathers light from around its centre, while its depth belongs to one surface. At a
silhouette the background's colour would bleed onto the object. There the colour's confidence is lowered to 1 of 255:
it counts only where no other frame shows the same place better.
"""

from functools import cache

import warp as wp

from fusion.devices import Kernel, launch_in_slabs
from fusion.frames.frame_batch import FrameBatch

# A pixel is at an edge where the 3×3 pixels around it span more than the step, or one of them has no depth. On the CPU
# a thread has a row of the image, whose inner pixels become vector lanes; on CUDA it has one pixel.
_JUDGE_IN_CPP = """
    const int height = depth.shape[1], width = depth.shape[2];
    const T *here = depth.data + ((size_t)frame * height + v) * width;
    const T *above = v > 0 ? here - width : here, *below = v < height - 1 ? here + width : here;
    unsigned char *out = confidence.data + ((size_t)frame * height + v) * width;
    auto judge = [&](int u, int before, int after) {
        T low = here[u], high = here[u];
        auto look = [&](T z) { low = z < low ? z : low; high = z > high ? z : high; };
        look(here[before]); look(here[after]);
        look(above[before]); look(above[u]); look(above[after]);
        look(below[before]); look(below[u]); look(below[after]);
        const T span = high - low;
        const bool edge = !(low > (T)0) | !(span <= step);
        out[u] = edge ? 1 : 255;
    };
    const int end = u0 + count;
    int u = u0;
    if (u == 0) { judge(0, 0, width > 1 ? 1 : 0); ++u; }
    for (; u < end && u < width - 1; ++u) judge(u, u - 1, u + 1);
    if (u < end) judge(u, u - 1, u);
"""


@cache
def kernel(depth_type: type) -> Kernel:
    """Return the kernel for depth of a type, uint16 or float32; its threads take ``count`` pixels of a row each."""
    declared = f"typedef {'unsigned short' if depth_type is wp.uint16 else 'float'} T; const T step = (T)largest_step;"

    @wp.func_native(declared + _JUDGE_IN_CPP)
    def judge_pixels(
        frame: int,
        v: int,
        u0: int,
        count: int,
        depth: wp.array3d(dtype=depth_type),
        largest_step: float,
        confidence: wp.array3d(dtype=wp.uint8),
    ) -> None:
        """Write the confidence of ``count`` pixels of a row."""

    @wp.kernel(module="unique", enable_backward=False)
    def judge_rows(
        first: int,
        count: int,
        depth: wp.array3d(dtype=depth_type),
        largest_step: float,
        confidence: wp.array3d(dtype=wp.uint8),
    ) -> None:
        parts = depth.shape[2] / count
        row = (wp.tid() + first) / parts
        part = wp.tid() + first - row * parts
        judge_pixels(row / depth.shape[1], row % depth.shape[1], part * count, count, depth, largest_step, confidence)

    return judge_rows


def judge_colors(batch: FrameBatch, *, step: float) -> None:
    """Fill in ``batch.confidence``: 1 where depth changes by more than ``step`` metres or ends, 255 elsewhere."""
    camera, device = batch.camera, batch.depth.device
    count = 1 if device.is_cuda else camera.width
    launch_in_slabs(
        kernel(batch.depth.dtype),
        dim=batch.depth.size // count,
        inputs=[count, batch.depth, min(step / batch.depth_scale, 65535.0)],
        outputs=[batch.confidence],
        device=device,
    )
