"""A query's depth aligned with small views of the model, from several of them at once.

Points are associated by projection and the distances to the model's tangent planes minimised (Blais and Levine 1995;
Chen and Medioni 1992) by Gauss–Newton with Huber weights. All starts go through the same array operations: with some
hundred points each, calls are what costs.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.rigid import Matrix, inverse
from fusion.pose.view_index import ViewIndex, cross

GATES = (0.3, 0.02)
"""Between a point and the model along the optical axis, in the query's depth: the first iteration's, and the least."""
GATE_SHRINKAGE = 0.7
LARGEST_DIFFERENCE = 0.02
"""In the query's depth: what lies farther apart, or has no counterpart, disagrees, and counts as much."""
HUBER = 2.0
FEWEST_POINTS = 20
DAMPING = 1e-6
SMALLEST_STEP, LARGEST_STEP = 2e-4, 0.15
"""Of a rotation in radians, of a translation in the query's depth."""


@dataclass(frozen=True, kw_only=True)
class Query:
    """A query as small as the index's views: ``depth`` (height, width) planar metres, 0 where there is no surface.

    ``known`` (height, width) is False where the query says nothing: outside a mask, where something else may stand
    before the model. ``points`` (m, 3) are those to align, in the query's frame; ``typical_depth`` is their median.
    """

    depth: NDArray[np.float64]
    known: NDArray[np.bool_]
    points: NDArray[np.float64]
    typical_depth: float


@dataclass(frozen=True, kw_only=True)
class Registrations:
    """For k views: ``view_from_query`` (k, 4, 4), and ``costs`` (k,) from 0, all agrees, to 1, nothing does."""

    view_from_query: NDArray[np.float64]
    costs: NDArray[np.float64]


def register(
    index: ViewIndex,
    views: NDArray[np.int64],
    query: Query,
    start: NDArray[np.float64],
    *,
    iterations: int,
    widest_gate: float = GATES[0],
) -> Registrations:
    """Align a query with k ``views`` of the index.

    ``start`` (k, 4, 4) are first guesses of view_from_query; ``widest_gate`` how far apart points may lie at first,
    in the query's depth. Views of which too few points agree keep the pose that they had, at cost 1.
    """
    depth = query.typical_depth
    view_from_query = start.copy()
    gate = widest_gate * depth
    for _ in range(iterations):
        step = _gauss_newton(index, views, query.points, view_from_query, gate=gate, depth=depth)
        view_from_query = _exponential(step) @ view_from_query
        gate = max(GATE_SHRINKAGE * gate, GATES[1] * depth)
        if np.abs(step).max() < SMALLEST_STEP:
            break
    costs = _costs(index, views, query, view_from_query, cap=LARGEST_DIFFERENCE * depth)
    return Registrations(view_from_query=view_from_query, costs=costs)


@dataclass(frozen=True, kw_only=True)
class _Associated:
    """For k views and m points: the points in the views' frames (k, m, 3), their pixels, and whether they have one."""

    points: NDArray[np.float64]
    pixels: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]
    inside: NDArray[np.bool_]


def _associate(
    index: ViewIndex, views: NDArray[np.int64], points_query: NDArray[np.float64], view_from_query: NDArray[np.float64]
) -> _Associated:
    points = points_query @ np.swapaxes(view_from_query[:, :3, :3], 1, 2) + view_from_query[:, None, :3, 3]
    camera = index.camera
    z = np.maximum(points[..., 2], 1e-9)
    u = np.rint(camera.fx * points[..., 0] / z + camera.cx)
    v = np.rint(camera.fy * points[..., 1] / z + camera.cy)
    inside = (points[..., 2] > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    rows, columns = (np.where(inside, place, 0).astype(np.int64) for place in (v, u))
    return _Associated(points=points, pixels=(views[:, None], rows, columns), inside=inside)


def _gauss_newton(
    index: ViewIndex,
    views: NDArray[np.int64],
    points_query: NDArray[np.float64],
    view_from_query: NDArray[np.float64],
    *,
    gate: float,
    depth: float,
) -> NDArray[np.float64]:
    """Return each view's step (k, 6), a rotation vector and a translation, applied from the left."""
    found = _associate(index, views, points_query, view_from_query)
    normals = index.normals[found.pixels]
    targets = index.rays[found.pixels[1:]] * index.depth[found.pixels][..., None]
    away = targets - found.points
    residuals = (normals * away).sum(axis=-1)
    used = found.inside & index.oriented[found.pixels] & (np.abs(away[..., 2]) < gate)
    counts = used.sum(axis=1)
    absolute = np.where(used, np.abs(residuals), 0)
    # The mean stands for the median, which sorting would cost: near a Gaussian, σ is 1.25 times it.
    scale = 1.25 * absolute.sum(axis=1) / np.maximum(counts, 1) + 1e-4 * depth
    weights = used / np.maximum(1, absolute / (HUBER * scale[:, None]))
    jacobian = np.concatenate([cross(found.points, normals), normals], axis=-1)
    weighted = np.swapaxes(jacobian * weights[..., None], 1, 2)
    left = weighted @ jacobian
    damping = DAMPING * np.trace(left, axis1=1, axis2=2) + 1e-12
    step = np.linalg.solve(left + damping[:, None, None] * np.eye(6), weighted @ residuals[..., None])[..., 0]
    # A plane lets the surface slide along it without end.
    size = np.maximum(np.linalg.norm(step[:, :3], axis=1), np.linalg.norm(step[:, 3:], axis=1) / depth)
    step *= np.minimum(1, LARGEST_STEP / np.maximum(size, 1e-300))[:, None]
    return np.where((counts >= FEWEST_POINTS)[:, None], step, 0)


def _costs(
    index: ViewIndex, views: NDArray[np.int64], query: Query, view_from_query: NDArray[np.float64], *, cap: float
) -> NDArray[np.float64]:
    """Return the mean difference in depth, capped, of the query's points from the model and of model's from it."""
    found = _associate(index, views, query.points, view_from_query)
    depth = index.depth[found.pixels]
    differences = np.where(found.inside & (depth > 0), np.minimum(np.abs(depth - found.points[..., 2]), cap), cap)
    forward = differences.mean(axis=1)
    backward = np.array(
        [
            _unexplained(index, index.depth[views[k]], query, inverse(pose), cap=cap)
            for k, pose in enumerate(view_from_query)
        ]
    )
    return (forward + backward) / (2 * cap)


def _unexplained(
    index: ViewIndex, view_depth: NDArray[np.float64], query: Query, query_from_view: Matrix, *, cap: float
) -> float:
    """Return how far the model's surface, seen from a view, is from the query's, where the query could have seen it.

    What lies behind another surface of the query is occluded, what lies outside its image unknown: neither counts.
    """
    points = index.points(view_depth[::2, ::2], step=2)
    if len(points) == 0:
        return cap
    found = _associate(index, np.zeros(1, np.int64), points, query_from_view[None])
    rows, columns = found.pixels[1][0], found.pixels[2][0]
    seen = query.depth[rows, columns]
    difference = found.points[0, :, 2] - seen
    known = found.inside[0] & query.known[rows, columns]
    counted = known & ((seen == 0) | (difference < cap))
    if not counted.any():
        return cap
    return float(np.where(seen == 0, cap, np.minimum(np.abs(difference), cap))[counted].mean())


def _exponential(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rigid transforms (k, 4, 4): Rodrigues' rotation of the first three numbers, then the translation."""
    vectors = steps[:, :3]
    angles = np.linalg.norm(vectors, axis=1)
    axes = vectors / np.maximum(angles, 1e-300)[:, None]
    x, y, z = axes.T
    zero = np.zeros_like(x)
    hats = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    result = np.tile(np.eye(4), (len(steps), 1, 1))
    result[:, :3, :3] += np.sin(angles)[:, None, None] * hats + (1 - np.cos(angles))[:, None, None] * (hats @ hats)
    result[:, :3, 3] = steps[:, 3:]
    return result
