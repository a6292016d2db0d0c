"""A query's depth aligned with small views of the model, from several of them at once.

Points are associated by projection and the distances to the model's tangent planes minimised (Blais and Levine 1995;
Chen and Medioni 1992) by Gauss–Newton with Huber weights. An iteration is two launches for all starts: one sums over
runs of points, one solves; nothing is waited for between them.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from fusion.pose.cholesky import Sums64, solve_symmetric
from fusion.pose.normal_equations import SUMS, Sums, add_residual
from fusion.pose.small_query import SmallQuery
from fusion.pose.small_views import Views, pixel_at, point_at, views_of
from fusion.pose.view_costs import alignment_costs
from fusion.pose.view_index import ViewIndex

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

GATES = (0.3, 0.02)
"""Between a point and the model along the optical axis, in the query's depth: the first iteration's, and the least."""
GATE_SHRINKAGE = 0.7
LARGEST_DIFFERENCE = 0.02
"""In the query's depth: what lies farther apart, or has no counterpart, disagrees, and counts as much."""
ROW_STEP = 2
"""Of the model's pixels that are looked for in the query, every second of every second row."""

_RUN = 32
"""Points a thread."""
_HUBER = wp.constant(2.0)
_FEWEST_POINTS = wp.constant(20.0)
_DAMPING = wp.constant(wp.float64(1e-6))
_LARGEST_STEP = wp.constant(wp.float64(0.15))
"""Of a rotation in radians, of a translation in the query's depth."""
_DEPTH_EDGE = wp.constant(0.06)
"""Pixels two apart whose depths differ by more than this share of them are not of one surface."""


@dataclass(frozen=True, kw_only=True)
class Registrations:
    """For k views: ``view_from_query`` (k, 4, 4), and ``costs`` (k,) from 0, all agrees, to 1, nothing does.

    The transforms are rigid to a float32's rounding.
    """

    view_from_query: NDArray[np.float64]
    costs: NDArray[np.float64]


@wp.struct
class Facet:
    """The model's surface at a pixel: a point, its unit normal, and whether there is one."""

    point: wp.vec3
    normal: wp.vec3
    known: bool


@wp.func
def facet_at(views: Views, view: int, pixel: wp.vec2i) -> Facet:
    """Return the surface at a pixel, its normal by central differences; none where the neighbours are of another."""
    found = Facet()
    v = pixel[0]
    u = pixel[1]
    if v < 1 or u < 1 or v > views.depth.shape[1] - 2 or u > views.depth.shape[2] - 2:
        return found
    left = point_at(views, view, v, u - 1)
    right = point_at(views, view, v, u + 1)
    above = point_at(views, view, v - 1, u)
    below = point_at(views, view, v + 1, u)
    found.point = point_at(views, view, v, u)
    z = found.point[2]
    if wp.min(z, wp.min(wp.min(left[2], right[2]), wp.min(above[2], below[2]))) <= 0.0:
        return found
    if wp.max(wp.abs(right[2] - left[2]), wp.abs(below[2] - above[2])) > _DEPTH_EDGE * z:
        return found
    found.normal = wp.normalize(wp.cross(right - left, below - above))
    found.known = True
    return found


@wp.kernel
def _gather(
    gate: float,
    views: Views,
    chosen: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3),
    stride: int,
    count: int,
    runs: int,
    rotations: wp.array(dtype=wp.mat33),
    translations: wp.array(dtype=wp.vec3),
    scales: wp.array(dtype=float),
    sums: wp.array2d(dtype=float),
) -> None:
    index = wp.tid()
    start = index / runs
    run = index % runs
    total = Sums()
    for i in range(run * _RUN, wp.min(run * _RUN + _RUN, count)):
        point = rotations[start] * points[i * stride] + translations[start]
        pixel = pixel_at(views, point)
        facet = facet_at(views, chosen[start], pixel)
        away = point - facet.point
        if facet.known and wp.abs(away[2]) < gate:
            r = wp.dot(facet.normal, away)
            weight = 1.0 / wp.max(1.0, wp.abs(r) / (_HUBER * scales[start]))
            total = add_residual(total, r, weight, facet.normal, point)
            total[27] += wp.abs(r)
            total[28] += 1.0
    for k in range(33):
        sums[index, k] = total[k]


@wp.kernel
def _move(
    steps: bool,
    sums: wp.array2d(dtype=float),
    runs: int,
    depth: float,
    scales: wp.array(dtype=float),
    rotations: wp.array(dtype=wp.mat33),
    translations: wp.array(dtype=wp.vec3),
) -> None:
    start = wp.tid()
    total = Sums64()
    for run in range(runs):
        for k in range(33):
            total[k] += wp.float64(sums[start * runs + run, k])
    count = total[28]
    # The mean stands for the median, which sorting would cost: near a Gaussian, σ is 1.25 times it.
    scales[start] = 1.25 * float(total[27] / wp.max(count, wp.float64(1.0))) + 1.0e-4 * depth
    if not steps or float(count) < _FEWEST_POINTS:
        return
    trace = total[0] + total[6] + total[11] + total[15] + total[18] + total[20]
    step = solve_symmetric(total, _DAMPING * trace + wp.float64(1e-12))
    shift = wp.spatial_top(step)
    turn = wp.spatial_bottom(step)
    # A plane lets the surface slide along it without end.
    size = wp.max(wp.length(turn), wp.length(shift) / wp.float64(depth))
    shrink = wp.min(wp.float64(1.0), _LARGEST_STEP / wp.max(size, wp.float64(1e-300)))
    angle = float(shrink * wp.length(turn))
    if angle > 0.0:
        unit = wp.normalize(turn)
        axis = wp.vec3(float(unit[0]), float(unit[1]), float(unit[2]))
        rotation = wp.quat_to_matrix(wp.quat_from_axis_angle(axis, angle))
        rotations[start] = rotation * rotations[start]
        translations[start] = rotation * translations[start]
    translations[start] += wp.vec3(float(shrink * shift[0]), float(shrink * shift[1]), float(shrink * shift[2]))


def register(
    index: ViewIndex,
    views: NDArray[np.int64],
    query: SmallQuery,
    start: NDArray[np.float64],
    *,
    points: int,
    iterations: int,
    widest_gate: float = GATES[0],
    row_step: int = ROW_STEP,
    largest_difference: float = LARGEST_DIFFERENCE,
) -> Registrations:
    """Align a query with k ``views`` of the index.

    ``start`` (k, 4, 4) are first guesses of view_from_query; about ``points`` of the query are used; ``widest_gate`` is
    how far apart points may lie at first, in the query's depth. Costs are those of
    ``alignment_costs``. Views of which too few points agree keep the pose that they had.
    """
    device, depth = index.device, query.typical_depth
    images = views_of(index)
    chosen = wp.array(views.astype(np.int32), dtype=int, device=device)
    rotations = wp.array(start[:, :3, :3].astype(np.float32), dtype=wp.mat33, device=device)
    translations = wp.array(start[:, :3, 3].astype(np.float32), dtype=wp.vec3, device=device)
    stride = max(len(query.points) // points, 1)
    count = -(-len(query.points) // stride)
    runs = -(-count // _RUN)
    scales = wp.full(len(views), 1e6, dtype=float, device=device)
    sums = wp.empty((len(views) * runs, SUMS), dtype=float, device=device)
    inputs = [images, chosen, query.points_there, stride, count, runs, rotations, translations, scales]
    # Recorded, a launch costs a tenth; shared among cores, it would cost more than it does.
    gather = wp.launch(_gather, dim=len(sums), inputs=[0.0, *inputs], outputs=[sums], device=device, record_cmd=True)
    inputs, outputs = [False, sums, runs, depth], [scales, rotations, translations]
    move = wp.launch(_move, dim=len(views), inputs=inputs, outputs=outputs, device=device, record_cmd=True)
    gate = widest_gate * depth
    for iteration in range(iterations + 1):
        gather.set_param_at_index(0, gate)
        gather.launch()
        # The first time it only tells how large the residuals are.
        move.set_param_at_index(0, iteration > 0)
        move.launch()
        if iteration > 0:
            gate = max(GATE_SHRINKAGE * gate, GATES[1] * depth)
    view_from_query = np.tile(np.eye(4), (len(views), 1, 1))
    view_from_query[:, :3, :3], view_from_query[:, :3, 3] = rotations.numpy(), translations.numpy()
    costs = alignment_costs(
        images,
        chosen,
        query,
        rotations,
        translations,
        stride=stride,
        row_step=row_step,
        largest_difference=largest_difference,
    )
    return Registrations(view_from_query=view_from_query, costs=costs)
