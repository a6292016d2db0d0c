"""The nearest already-fused pose, from geometry only (the paper's section IV-C).

The paper takes the pose whose TSDF surface points have the least mean squared error from the query's. Between views
that lie some degrees apart, that error tells little: an outline that has moved by a few pixels outweighs all
differences in shape. So the query is first aligned with views of the model, and the mean squared error taken after it;
of all fused poses, the one that is nearest to the aligned query is returned. Texture plays no part.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.rigid import Matrix, rigid
from fusion.pose.pose_distance import first_apart, pose_distances
from fusion.pose.small_query import SmallQuery, small_query
from fusion.pose.view_index import ViewIndex
from fusion.pose.view_search import (
    APART,
    Alignments,
    align_all_over,
    align_best_again,
    align_where_they_are,
    align_with_similar_views,
)

LARGEST_DIFFERENCE = 0.1
"""Depths differ by at most this share of the query's median depth; more, or no surface at all, counts as much."""

AMBIGUOUS_MARGIN = 0.25
"""A second alignment whose cost is larger by no more than this share of it is as good as the first."""

SURE_COST = 1 / 3
"""Of the alignment with the nearest view: where less than two thirds agree, what was tried may have been nowhere near.
Pixels at edges, and what one of the two does not see, disagree in a right one, too."""

_CLEAR_MARGIN = 0.5
"""The same of poses that the model was seen again from, before views all over it are tried. Of 280 views of random
solids two wrong poses had less, and none had more."""

OTHERS = 3
_OTHERS_MARGIN = 1.0
"""Of the costs of other alignments that are worth a refinement, before the first is believed."""


@dataclass(frozen=True, kw_only=True)
class NearestPose:
    """The fused poses nearest to a query, best first.

    ``indices`` (k,) into the candidates; ``scores`` (k,) in m², the mean squared difference between the query's depth
    and that of the model seen from there; ``estimate`` world_from_camera of the query as aligned, ``cost`` from 0 to 1
    how badly. ``margin`` is how much larger, in shares of ``cost``, the cost of the best other alignment is: near 0
    the query looks alike from two sides, and ``ambiguous`` says so. ``others`` (m, 4, 4) are alignments elsewhere that
    are not much worse, best first, for a refinement to choose among.
    """

    indices: NDArray[np.int64]
    scores: NDArray[np.float64]
    estimate: Matrix
    cost: float
    margin: float
    others: NDArray[np.float64]

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
    similar = align_with_similar_views(index, query)
    tried = align_best_again(index, query, similar)
    if not _is_sure(tried, query, margin=AMBIGUOUS_MARGIN):
        tried = align_where_they_are(index, query, tried)
        if not _is_sure(tried, query, margin=_CLEAR_MARGIN):
            tried = align_all_over(index, query, similar)
    estimate = rigid(tried.poses[0], source="alignment with the model's views")
    distances = pose_distances(index.world_from_camera, estimate, depth=query.typical_depth)
    nearest = np.argsort(distances, kind="stable")[:count]
    return NearestPose(
        indices=nearest,
        scores=_mean_squared_differences(index, nearest, query),
        estimate=estimate,
        cost=float(tried.costs[0]),
        margin=tried.margin(depth=query.typical_depth),
        others=_others(tried, depth=query.typical_depth),
    )


def _is_sure(tried: Alignments, query: SmallQuery, *, margin: float) -> bool:
    return bool(tried.costs[0] <= SURE_COST and tried.margin(depth=query.typical_depth) >= margin)


def _others(tried: Alignments, *, depth: float) -> NDArray[np.float64]:
    """Return the poses (m, 4, 4) of alignments elsewhere that are worth a refinement."""
    apart = first_apart(tried.poses, apart=APART, depth=depth)
    good = [i for i in apart[1:] if tried.margins[i] <= _OTHERS_MARGIN]
    return np.array([rigid(tried.poses[i], source="another alignment") for i in good[:OTHERS]], np.float64).reshape(
        -1, 4, 4
    )


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
