"""The nearest already-fused pose, from geometry only (the paper's section IV-C).

The paper takes the pose whose TSDF surface points have the least mean squared error from the query's. Between views
that lie some degrees apart, that error tells little: an outline that has moved by a few pixels outweighs all
differences in shape. So the query is first aligned with the views that are similar in shape, wherever they lie in the
image, and the mean squared error taken after it; of all fused poses, the one that is nearest to the aligned query is
returned. Texture plays no part.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.errors import InputError
from datagen.rigid import Matrix, inverse
from fusion.pose.view_index import ViewIndex, turn_between, view_patch
from fusion.pose.view_registration import Query, register

STARTS = 8
APART_DEG = 12.0
"""Between views that are tried; nearer ones lead to the same alignment."""

PATCH_CAP = 0.3
"""In radii: patches differ by no more in a cell."""

POINTS_AT_FIRST, POINTS_AT_LAST = 300, 1500
ITERATIONS_AT_FIRST, ITERATIONS_AT_LAST = 10, 6
GATE_AT_LAST = 0.05

LARGEST_DIFFERENCE = 0.1
"""Depths differ by at most this share of the query's median depth; more, or no surface at all, counts as much."""

AMBIGUOUS_MARGIN = 0.25
"""A second alignment whose cost is larger by no more than this share of it is as good as the first."""


@dataclass(frozen=True, kw_only=True)
class NearestPose:
    """The fused poses nearest to a query, best first.

    ``indices`` (k,) into the candidates; ``scores`` (k,) in m², the mean squared difference between the query's depth
    and that of the model seen from there; ``estimate`` world_from_camera of the query as aligned, ``cost`` from 0 to 1
    how badly. ``margin`` is how much larger, in shares of ``cost``, the cost of the best other alignment is: near 0
    the query looks alike from two sides, and ``ambiguous`` says so.
    """

    indices: NDArray[np.int64]
    scores: NDArray[np.float64]
    estimate: Matrix
    cost: float
    margin: float

    @property
    def index(self) -> int:
        """The best of the candidates."""
        return int(self.indices[0])

    @property
    def ambiguous(self) -> bool:
        """Whether another alignment, some way off, is about as good."""
        return self.margin < AMBIGUOUS_MARGIN


def find_nearest_pose(
    index: ViewIndex, depth: NDArray[np.float32], *, mask: NDArray[np.bool_] | None = None, count: int = 5
) -> NearestPose:
    """Return the ``count`` fused poses nearest to a query's planar depth (height, width), metres, 0 = invalid.

    Where there is a ``mask`` (height, width), only what it covers is compared; elsewhere anything may stand before the
    model. Distances between poses are those of ``pose_distances``. Raises InputError where the query has no valid
    depth, or the mask covers none.
    """
    query = _query(index, depth, mask)
    starts = _similar_views(index, query)
    first = register(
        index,
        starts,
        _thinned(query, POINTS_AT_FIRST),
        _on_line_of_sight(index, starts, query),
        iterations=ITERATIONS_AT_FIRST,
    )
    poses = index.world_from_camera[starts] @ first.view_from_query
    best = int(first.costs.argmin())
    estimate, cost = _polish(index, query, poses[best])
    distances = pose_distances(index.world_from_camera, estimate, depth=query.typical_depth)
    nearest = np.argsort(distances, kind="stable")[:count]
    return NearestPose(
        indices=nearest,
        scores=np.array([_mean_squared_difference(index, int(i), query) for i in nearest]),
        estimate=estimate,
        cost=cost,
        margin=_margin(poses, first.costs, best),
    )


def pose_distances(world_from_camera: NDArray[np.float64], pose: Matrix, *, depth: float) -> NDArray[np.float64]:
    """Return how far poses (n, 4, 4) are from another, in radians (n,).

    A rotation's angle and the camera's shift as seen at ``depth`` metres count alike: √(θ² + (‖t‖/depth)²), a geodesic
    distance of SO(3) × R³.
    """
    relative = np.swapaxes(world_from_camera[:, :3, :3], 1, 2) @ pose[:3, :3]
    sines = np.stack([relative[:, i, j] - relative[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1)
    angles = np.arctan2(np.linalg.norm(sines, axis=1), np.trace(relative, axis1=1, axis2=2) - 1)
    shifts = np.linalg.norm(world_from_camera[:, :3, 3] - pose[:3, 3], axis=1)
    return np.hypot(angles, shifts / depth)


def _query(index: ViewIndex, depth: NDArray[np.float32], mask: NDArray[np.bool_] | None) -> Query:
    small = depth[:: index.step, :: index.step].astype(np.float64)
    known = np.ones(small.shape, bool)
    if mask is not None:
        known = mask[:: index.step, :: index.step]
        small = np.where(known, small, 0)
    points = index.points(small)
    if len(points) == 0:
        where = "" if mask is None else " inside the mask"
        raise InputError(f"no pixel{where} has a valid depth, so there is no surface to compare")
    return Query(depth=small, known=known, points=points, typical_depth=float(np.median(points[:, 2])))


def _thinned(query: Query, count: int) -> Query:
    step = max(len(query.points) // count, 1)
    return Query(depth=query.depth, known=query.known, points=query.points[::step], typical_depth=query.typical_depth)


def _similar_views(index: ViewIndex, query: Query) -> NDArray[np.int64]:
    """Return the views whose patches are most like the query's, each some way from the others."""
    patch = view_patch(query.points, index.radius)
    differences = np.minimum(np.abs(index.patches - patch), PATCH_CAP)
    order = np.argsort(np.einsum("ij,ij->i", differences, differences), kind="stable")
    chosen: list[int] = []
    left = np.ones(len(order), bool)
    forward = index.world_from_camera[:, :3, :3]
    for view in order:
        if left[view]:
            chosen.append(int(view))
            traces = np.einsum("nij,ij->n", forward, forward[view])
            left &= traces < 1 + 2 * np.cos(np.radians(APART_DEG))
            if len(chosen) == STARTS:
                break
    return np.array(chosen)


def _on_line_of_sight(index: ViewIndex, views: NDArray[np.int64], query: Query) -> NDArray[np.float64]:
    """Return first guesses of view_from_query (k, 4, 4): the middles of both surfaces, and the lines to them, agree."""
    guesses = np.tile(np.eye(4), (len(views), 1, 1))
    ours = np.median(query.points, axis=0)
    for guess, view in zip(guesses, views, strict=True):
        cloud = index.points(index.depth[view])
        if len(cloud):
            theirs = np.median(cloud, axis=0)
            guess[:3, :3] = turn_between(ours, theirs)
            guess[:3, 3] = theirs - guess[:3, :3] @ ours
    return guesses


def _polish(index: ViewIndex, query: Query, pose: Matrix) -> tuple[Matrix, float]:
    """Align again with the view that is nearest now; returns world_from_camera and the cost."""
    view = int(pose_distances(index.world_from_camera, pose, depth=query.typical_depth).argmin())
    world_from_view = index.world_from_camera[view]
    aligned = register(
        index,
        np.array([view]),
        _thinned(query, POINTS_AT_LAST),
        (inverse(world_from_view) @ pose)[None],
        iterations=ITERATIONS_AT_LAST,
        widest_gate=GATE_AT_LAST,
    )
    return world_from_view @ aligned.view_from_query[0], float(aligned.costs[0])


def _margin(poses: NDArray[np.float64], costs: NDArray[np.float64], best: int) -> float:
    """Return by what share the cost of the best alignment at another place exceeds the least; infinite for none."""
    traces = np.einsum("nij,ij->n", poses[:, :3, :3], poses[best, :3, :3])
    elsewhere = traces < 1 + 2 * np.cos(np.radians(APART_DEG))
    if not elsewhere.any():
        return float("inf")
    return float(costs[elsewhere].min() / max(costs[best], 1e-9) - 1)


def _mean_squared_difference(index: ViewIndex, view: int, query: Query) -> float:
    """Return the mean squared difference in depth, m², over the pixels where query or model have a surface."""
    largest = LARGEST_DIFFERENCE * query.typical_depth
    ours, theirs = query.depth, index.depth[view]
    either = query.known & ((ours > 0) | (theirs > 0))
    both = (ours > 0) & (theirs > 0)
    difference = np.where(both, np.minimum(np.abs(ours - theirs), largest), largest)
    return float((difference[either] ** 2).mean())
