"""The nearest already-fused pose, from geometry only (the paper's section IV-C).

The paper takes the pose whose TSDF surface points have the least mean squared error from the query's. Between views
that lie some degrees apart, that error tells little: an outline that has moved by a few pixels outweighs all
differences in shape. So the query is first aligned with the views that are similar in shape, wherever they lie in the
image, and the mean squared error taken after it; of all fused poses, the one that is nearest to the aligned query is
returned. Texture plays no part.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.errors import InputError
from datagen.rigid import Matrix, inverse, rigid
from fusion.pose.view_index import ViewIndex, patch_differences, turn_between, view_patches
from fusion.pose.view_registration import SmallQuery, register

STARTS = 8
APART_DEG = 12.0
"""Between views that are tried; nearer ones lead to the same alignment."""

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
    query = small_query(index, depth, mask)
    starts = _similar_views(index, query)
    first = register(
        index,
        starts,
        query,
        _on_line_of_sight(index, starts, query),
        points=POINTS_AT_FIRST,
        iterations=ITERATIONS_AT_FIRST,
    )
    poses = index.world_from_camera[starts] @ first.view_from_query
    best = int(first.costs.argmin())
    estimate, cost = _polish(index, query, poses[best])
    distances = pose_distances(index.world_from_camera, estimate, depth=query.typical_depth)
    nearest = np.argsort(distances, kind="stable")[:count]
    return NearestPose(
        indices=nearest,
        scores=_mean_squared_differences(index, nearest, query),
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


def small_query(index: ViewIndex, depth: NDArray[np.float32], mask: NDArray[np.bool_] | None) -> SmallQuery:
    """Return a query's depth, and its mask if it has one, (height, width), as small as the index's views.

    Raises InputError where no pixel has a valid depth.
    """
    small = depth[:: index.step, :: index.step].astype(np.float32)
    known = np.ones(small.shape, bool)
    if mask is not None:
        known = mask[:: index.step, :: index.step]
        small = np.where(known, small, np.float32(0))
    points = index.points(small)
    if len(points) == 0:
        where = "" if mask is None else " inside the mask"
        raise InputError(f"no pixel{where} has a valid depth, so there is no surface to compare")
    return SmallQuery(
        depth=small,
        known=known,
        points=points,
        middle=np.median(points, axis=0),
        points_there=wp.array(points.astype(np.float32), dtype=wp.vec3, device=index.device),
        depth_there=wp.array(small, dtype=float, device=index.device),
        known_there=wp.array(known.astype(np.uint8), dtype=wp.uint8, device=index.device),
    )


def _similar_views(index: ViewIndex, query: SmallQuery) -> NDArray[np.int64]:
    """Return the views whose patches are most like the query's, each some way from the others."""
    image = query.depth_there.reshape((1, *query.depth.shape))
    patch = view_patches(index, image, query.middle[None], bands=query.depth.shape[0] if index.device.is_cuda else 1)
    order = np.argsort(patch_differences(index, patch), kind="stable")
    chosen: list[int] = []
    left = np.ones(len(order), bool)
    turns = index.world_from_camera[:, :3, :3]
    for view in order:
        if left[view]:
            chosen.append(int(view))
            left &= np.einsum("nij,ij->n", turns, turns[view]) < 1 + 2 * np.cos(np.radians(APART_DEG))
            if len(chosen) == STARTS:
                break
    return np.array(chosen)


def _on_line_of_sight(index: ViewIndex, views: NDArray[np.int64], query: SmallQuery) -> NDArray[np.float64]:
    """Return first guesses of view_from_query (k, 4, 4): the middles of both surfaces, and the lines to them, agree."""
    guesses = np.tile(np.eye(4), (len(views), 1, 1))
    for guess, theirs in zip(guesses, index.middles[views], strict=True):
        if theirs.any():
            guess[:3, :3] = turn_between(query.middle, theirs)
            guess[:3, 3] = theirs - guess[:3, :3] @ query.middle
    return guesses


def _polish(index: ViewIndex, query: SmallQuery, pose: Matrix) -> tuple[Matrix, float]:
    """Align again with the view that is nearest now; returns world_from_camera and the cost."""
    view = int(pose_distances(index.world_from_camera, pose, depth=query.typical_depth).argmin())
    world_from_view = index.world_from_camera[view]
    aligned = register(
        index,
        np.array([view]),
        query,
        (inverse(world_from_view) @ pose)[None],
        points=POINTS_AT_LAST,
        iterations=ITERATIONS_AT_LAST,
        widest_gate=GATE_AT_LAST,
    )
    pose = rigid(world_from_view @ aligned.view_from_query[0], source="alignment with the nearest view")
    return pose, float(aligned.costs[0])


def _margin(poses: NDArray[np.float64], costs: NDArray[np.float64], best: int) -> float:
    """Return by what share the cost of the best alignment at another place exceeds the least; infinite for none."""
    traces = np.einsum("nij,ij->n", poses[:, :3, :3], poses[best, :3, :3])
    elsewhere = traces < 1 + 2 * np.cos(np.radians(APART_DEG))
    if not elsewhere.any():
        return float("inf")
    return float(costs[elsewhere].min() / max(costs[best], 1e-9) - 1)


def _mean_squared_differences(index: ViewIndex, views: NDArray[np.int64], query: SmallQuery) -> NDArray[np.float64]:
    """Return the mean squared differences in depth (k,), m², over the pixels where query or model have a surface."""
    largest = LARGEST_DIFFERENCE * query.typical_depth
    ours, scores = query.depth, []
    for view in views:
        theirs = index.depth[int(view)].numpy()
        either = query.known & ((ours > 0) | (theirs > 0))
        both = (ours > 0) & (theirs > 0)
        difference = np.where(both, np.minimum(np.abs(ours - theirs), largest), largest)
        scores.append(float((difference[either].astype(np.float64) ** 2).mean()))
    return np.array(scores)
