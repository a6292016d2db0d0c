"""What each frame tells about places, one in each eighth of a part of a block (``frame_choice``)."""

from functools import cache
from typing import Any

import warp as wp

from fusion.devices import Kernel
from fusion.integration.visible_blocks import PARTS
from fusion.surface.dual_contouring.depth_views import LOOK_IN_CPP, declared, views_type

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

PLACES = 8
"""In a part: one in each box of 4×2×2 voxels."""

_PARTS = wp.constant(PARTS)
_PLACES = wp.constant(PLACES)

_SCORE_IN_CPP = """
    const int frames = depth.shape[0], stride = projections.shape[1];
    float *told = scores.data + (size_t)at * stride;
    for (int first = 0; first < frames; first += LANES) {
        const V one = 1.0f;
        V distance, weight;
        auto frame_at = [&](int lane) { return first + lane < frames ? first + lane : first; };
        look(projections.data + first, stride, frame_at, distance, weight);
        const V square = distance * distance, score = weight / (square > one ? square : one);
        for (int lane = 0; lane < LANES; ++lane) told[first + lane] = lanes_of(score)[lane];
    }
"""


@cache
def score_kernel(depth_type: type, *, weighted: bool) -> Kernel:
    """Return the kernel that asks all frames about places; a thread takes a place."""

    @wp.func_native(declared(depth_type, weighted=weighted) + LOOK_IN_CPP + _SCORE_IN_CPP)
    def score_frames(
        x: float,
        y: float,
        z: float,
        depth: wp.array3d(dtype=depth_type),
        pixel_weights: wp.array3d(dtype=float),
        depth_scale: float,
        intrinsics: wp.vec4,
        projections: wp.array2d(dtype=float),
        truncation: float,
        voxel_size: float,
        at: int,
        scores: wp.array2d(dtype=float),
    ) -> None:
        """Write what each frame tells about a place."""

    all_views: Any = views_type(depth_type)

    @wp.kernel(module="unique", enable_backward=False, module_options={"max_unroll": 1})
    def score(
        first: int,
        first_row: int,
        rows: wp.array(dtype=int),
        places: wp.array2d(dtype=int),
        blocks: wp.array(dtype=wp.vec3i),
        views: all_views,
        scores: wp.array2d(dtype=float),
    ) -> None:
        at = wp.tid() + first
        row = rows[first_row + at / _PLACES]
        voxel = places[row, at % _PLACES]
        if voxel < 0:
            return
        corner = 8 * blocks[row / _PARTS]
        score_frames(
            float(corner[0] + (voxel & 7)),
            float(corner[1] + ((voxel >> 3) & 7)),
            float(corner[2] + (voxel >> 6)),
            views.depth,
            views.pixel_weights,
            views.depth_scale,
            views.intrinsics,
            views.projections,
            views.truncation,
            views.voxel_size,
            at,
            scores,
        )

    return score
