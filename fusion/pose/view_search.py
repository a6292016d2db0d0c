"""Where a query can have been taken: it is aligned with views of the model, and those that fit best are kept.

First with the few views whose patches are most like the query's: that is quick, and nearly always enough. Where they do
not decide it, since something hides a part, or two sides look alike, or no view was taken from near there, the model is
seen again from where the best two have the camera, which often is. Else the query is aligned with views all over the
model, and the model seen again from where the best of these alignments have the camera, so that all of them are
compared with the query pixel by pixel.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.rigid import inverse
from fusion.pose.pose_distance import first_apart, pose_distances
from fusion.pose.small_query import SmallQuery
from fusion.pose.view_index import ViewIndex, patch_differences, seen_from, turn_between, view_patches
from fusion.pose.view_registration import register

APART = 0.3
"""Radians, a shift by the query's depth counting as one, between views that are tried; nearer ones lead to the same
alignment. On the way around an object that is 12°: the camera turns and is shifted."""

SIMILAR_VIEWS = 8
_POINTS, _ITERATIONS = 300, 10
_LAST_POINTS, _LAST_ITERATIONS, _LAST_GATE = 1500, 6, 0.05

_ALL_VIEWS, _ALL_APART = 256, 0.15
"""Half of the former: an alignment with a part of a scene comes right from no farther off."""
_ALL_POINTS, _ALL_ITERATIONS, _ALL_ROW_STEP, _ALL_DIFFERENCE = 100, 8, 4, 0.06
_KEPT = 6

_AGAIN_POINTS, _AGAIN_ITERATIONS = 1000, 6
_AGAIN_GATES = (0.1, 0.05)

_LEAST_COST = 0.05
"""An outline that is off by a pixel of the small images costs as much: less says nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignments:
    """Poses (k, 4, 4), world_from_camera, of a query, best first, with their ``costs`` (k,) from 0 to 1."""

    poses: NDArray[np.float64]
    costs: NDArray[np.float64]

    @property
    def margins(self) -> NDArray[np.float64]:
        """By what share (k,) of the least cost each is larger; costs that small images cannot tell apart are alike."""
        return (self.costs - self.costs[0]) / max(self.costs[0], _LEAST_COST)

    def margin(self, *, depth: float) -> float:
        """Return the margin of the best alignment at another place; infinite for none."""
        elsewhere = pose_distances(self.poses, self.poses[0], depth=depth) >= APART
        return float(self.margins[elsewhere].min()) if elsewhere.any() else float("inf")


def _sorted(poses: NDArray[np.float64], costs: NDArray[np.float64]) -> Alignments:
    order = np.argsort(costs, kind="stable")
    return Alignments(poses=poses[order], costs=costs[order])


def align_with_similar_views(index: ViewIndex, query: SmallQuery) -> Alignments:
    """Align a query with the views whose patches are most like its own, each some way from the others."""
    views = _by_similarity(index, query, apart=APART, most=SIMILAR_VIEWS)
    guesses = _on_line_of_sight(index, views, query)
    found = register(index, views, query, guesses, points=_POINTS, iterations=_ITERATIONS)
    return _sorted(index.world_from_camera[views] @ found.view_from_query, found.costs)


def align_all_over(index: ViewIndex, query: SmallQuery, known: Alignments) -> Alignments:
    """Align a query with views all over the model; ``known`` alignments take part in the choice of the best.

    Both with the middles of what is seen on one line of sight, as of an object somewhere in the image, and from the
    view's own pose, as in a scene of which both see a part.
    """
    views = _by_similarity(index, query, apart=_ALL_APART, most=_ALL_VIEWS)
    guesses = np.concatenate([_on_line_of_sight(index, views, query), np.tile(np.eye(4), (len(views), 1, 1))])
    views = np.tile(views, 2)
    found = register(
        index,
        views,
        query,
        guesses,
        points=_ALL_POINTS,
        iterations=_ALL_ITERATIONS,
        row_step=_ALL_ROW_STEP,
        largest_difference=_ALL_DIFFERENCE,
    )
    every = _sorted(index.world_from_camera[views] @ found.view_from_query, found.costs)
    # Costs of the two kinds cannot be compared: the best of each are taken in turn, first of those from nearer views.
    turns = np.argsort(np.concatenate([np.arange(len(every.poses)), np.arange(len(known.poses)) + 0.5]))
    poses = np.concatenate([every.poses, known.poses])[turns]
    best = poses[first_apart(poses, apart=APART, depth=query.typical_depth, most=_KEPT)]
    # Twice, for it may be moved far.
    return _compared(index, query, best, gates=_AGAIN_GATES)


def align_where_they_are(index: ViewIndex, query: SmallQuery, known: Alignments) -> Alignments:
    """Align a query with the model as seen from the best of ``known`` poses, and the best elsewhere.

    What the nearest view does not see of the model, and the query does, makes the cost of a right pose high until then.
    """
    best = known.poses[first_apart(known.poses, apart=APART, depth=query.typical_depth, most=2)]
    return _compared(index, query, best, gates=_AGAIN_GATES[-1:])


def _compared(
    index: ViewIndex, query: SmallQuery, poses: NDArray[np.float64], *, gates: tuple[float, ...]
) -> Alignments:
    """Align a query with the model as seen from ``poses`` (k, 4, 4) themselves, once for each of the ``gates``."""
    same = np.tile(np.eye(4), (len(poses), 1, 1))
    for gate in gates:
        seen = seen_from(index, poses)
        found = register(
            seen,
            np.arange(len(poses)),
            query,
            same,
            points=_AGAIN_POINTS,
            iterations=_AGAIN_ITERATIONS,
            widest_gate=gate,
        )
        poses = poses @ found.view_from_query
    return _sorted(poses, found.costs)


def _by_similarity(index: ViewIndex, query: SmallQuery, *, apart: float, most: int) -> NDArray[np.int64]:
    """Return the views whose patches are most like the query's, each ``apart`` or more from the others."""
    image = query.depth_there.reshape((1, *query.depth.shape))
    patch = view_patches(index, image, query.middle[None], bands=query.depth.shape[0] if index.device.is_cuda else 1)
    order = np.argsort(patch_differences(index, patch), kind="stable")
    poses = index.world_from_camera[order]
    return order[first_apart(poses, apart=apart, depth=query.typical_depth, most=most)]


def _on_line_of_sight(index: ViewIndex, views: NDArray[np.int64], query: SmallQuery) -> NDArray[np.float64]:
    """Return first guesses of view_from_query (k, 4, 4): the middles of both surfaces, and the lines to them, agree."""
    guesses = np.tile(np.eye(4), (len(views), 1, 1))
    for guess, theirs in zip(guesses, index.middles[views], strict=True):
        if theirs.any():
            guess[:3, :3] = turn_between(query.middle, theirs)
            guess[:3, 3] = theirs - guess[:3, :3] @ query.middle
    return guesses


def align_best_again(index: ViewIndex, query: SmallQuery, known: Alignments) -> Alignments:
    """Align a query again, each time with the view that is nearest by now: from the best pose, and the best elsewhere.

    Against views some way off, right poses and wrong ones cost about alike. Poses are rigid to a float32's rounding.
    """
    poses = known.poses[first_apart(known.poses, apart=APART, depth=query.typical_depth, most=2)]
    views = np.array(
        [pose_distances(index.world_from_camera, pose, depth=query.typical_depth).argmin() for pose in poses]
    )
    world_from_views = index.world_from_camera[views]
    found = register(
        index,
        views,
        query,
        np.stack([inverse(view) @ pose for view, pose in zip(world_from_views, poses, strict=True)]),
        points=_LAST_POINTS,
        iterations=_LAST_ITERATIONS,
        widest_gate=_LAST_GATE,
    )
    return _sorted(world_from_views @ found.view_from_query, found.costs)
