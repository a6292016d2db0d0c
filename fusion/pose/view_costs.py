"""How badly a query agrees with small views of the model that it was aligned with, both ways."""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from fusion.devices import launch_in_slabs
from fusion.pose.small_query import SmallQuery
from fusion.pose.small_views import Views, pixel_at, point_at

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_RUN = 32
"""Points a thread."""
_LEAST_SLAB = 256
"""Threads that are not worth being shared among cores: that costs as much as some thousand points do."""


@wp.kernel
def _compare_points(
    first: int,
    views: Views,
    chosen: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3),
    stride: int,
    count: int,
    runs: int,
    cap: float,
    rotations: wp.array(dtype=wp.mat33),
    translations: wp.array(dtype=wp.vec3),
    differences: wp.array(dtype=wp.vec2),
) -> None:
    index = wp.tid() + first
    start = index / runs
    run = index % runs
    total = wp.vec2()
    for i in range(run * _RUN, wp.min(run * _RUN + _RUN, count)):
        point = rotations[start] * points[i * stride] + translations[start]
        pixel = pixel_at(views, point)
        difference = float(cap)
        if pixel[0] >= 0:
            z = views.depth[chosen[start], pixel[0], pixel[1]]
            if z > 0.0:
                difference = wp.min(wp.abs(z - point[2]), cap)
        total += wp.vec2(difference, 1.0)
    differences[index] = total


@wp.kernel
def _compare_views(
    first: int,
    views: Views,
    chosen: wp.array(dtype=int),
    query: wp.array2d(dtype=float),
    known: wp.array2d(dtype=wp.uint8),
    rows: int,
    row_step: int,
    cap: float,
    rotations: wp.array(dtype=wp.mat33),
    translations: wp.array(dtype=wp.vec3),
    differences: wp.array(dtype=wp.vec2),
) -> None:
    index = wp.tid() + first
    start = index / rows
    v = row_step * (index % rows)
    back = wp.transpose(rotations[start])
    total = wp.vec2()
    for u in range(0, views.depth.shape[2], row_step):
        target = point_at(views, chosen[start], v, u)
        if target[2] > 0.0:
            point = back * (target - translations[start])
            pixel = pixel_at(views, point)
            if pixel[0] >= 0:
                seen = query[pixel[0], pixel[1]]
                # What lies behind another surface of the query is occluded, what its mask leaves out unknown.
                if known[pixel[0], pixel[1]] != wp.uint8(0) and (seen == 0.0 or point[2] - seen < cap):
                    difference = wp.where(seen == 0.0, cap, wp.min(wp.abs(point[2] - seen), cap))
                    total += wp.vec2(difference, 1.0)
    differences[index] = total


def alignment_costs(
    images: Views,
    chosen: wp.array,
    query: SmallQuery,
    rotations: wp.array,
    translations: wp.array,
    *,
    stride: int,
    row_step: int,
    largest_difference: float,
) -> NDArray[np.float64]:
    """Return the costs (k,), 0 to 1, of the query's place in the ``chosen`` views (k,).

    It is the mean difference in depth of the query's points, every ``stride``-th, from the model and of the model's,
    every ``row_step``-th of every ``row_step``-th row, from the query, both at most ``largest_difference`` of the
    query's depth, which counts 1. ``rotations``, ``translations`` (k,) are view_from_query.
    """
    cap = largest_difference * query.typical_depth
    count = -(-len(query.points) // stride)
    runs, rows = -(-count // _RUN), -(-images.depth.shape[1] // row_step)
    both = []
    for kernel, threads, inputs in (
        (_compare_points, runs, [query.points_there, stride, count, runs]),
        (_compare_views, rows, [query.depth_there, query.known_there, rows, row_step]),
    ):
        differences = wp.empty(len(chosen) * threads, dtype=wp.vec2, device=chosen.device)
        launch_in_slabs(
            kernel,
            dim=len(differences),
            inputs=[images, chosen, *inputs, cap, rotations, translations],
            outputs=[differences],
            device=chosen.device,
            least_slab=_LEAST_SLAB,
        )
        total, counted = differences.numpy().reshape(len(chosen), threads, 2).sum(axis=1, dtype=np.float64).T
        both.append(np.where(counted > 0, total / np.maximum(counted, 1), cap))
    return np.asarray(sum(both) / (2 * cap))
