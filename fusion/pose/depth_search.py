"""Descents by depth from one start and from many: from few points to many, and from a wide kernel to a narrow one.

Starts compete: each round descends with more points from fewer of them, those that explain the view best both ways.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from datagen.rigid import Matrix
from fusion.pose.depth_problem import MIDDLE_POINTS, DepthProblem
from fusion.pose.levenberg_marquardt import Descent
from fusion.pose.normal_equations import GEMAN_MCCLURE, TUKEY
from fusion.pose.query import MOST_POINTS
from fusion.pose.starting_poses import shifted_onto_depth

CLEARLY = 1.03
"""By this factor a pose farther from the start has to explain the view better, lest symmetry turn the model round."""

_TUKEY_SIGMAS = 4.685
"""Tukey's kernel of this many standard deviations has 95 % of the efficiency of least squares."""
_NOISE_ALONE = 1.25
"""Residuals of this many of their expected standard deviations are noise and nothing else."""
_COARSE_POINTS = 500
_COARSE_ROUNDS, _COARSE_STEPS, _MIDDLE_STEPS, _FINE_STEPS, _LAST_STEPS = 4, 4, 6, 12, 3
_MANY_POINTS, _KEPT = 300, 4
_FEW_POINTS, _FEW_ROUNDS, _KEPT_OF_HUNDREDS = 100, 3, 24
_HUNDREDS, _TENS = 60, 10
"""Starts, from which on they first descend with fewer points; and up to which the best of few points is taken."""


def from_one(problem: DepthProblem, start: Matrix, others: NDArray[np.float64]) -> Descent:
    """Descend from one start to nearly right; as it is, and shifted so that the model is where the depth is.

    Of a view that the image's edge cuts off, nothing tells where the model has to go, and there is no shift. ``others``
    (m, 4, 4) are taken instead where they explain the view clearly better.
    """
    own = start[None]
    if not problem.is_cut:
        own = np.concatenate([own, shifted_onto_depth(problem.model, own, problem.cloud.points_camera)])
    poses, spent = coarse(problem, np.concatenate([own, others]), count=_COARSE_POINTS)
    scores = problem.scores(poses)
    best = int(scores[: len(own)].argmax())
    found = nearly(problem, poses[best][None])
    spent += found.iterations
    if len(others) and scores[len(own) :].max() > scores[best]:
        other = nearly(problem, poses[len(own) + int(scores[len(own) :].argmax())][None])
        spent += other.iterations
        found = better(problem, found, other)
    return replace(found, iterations=spent)


def coarse(
    problem: DepthProblem, poses: NDArray[np.float64], *, count: int, rounds: int = _COARSE_ROUNDS
) -> tuple[NDArray[np.float64], int]:
    """Descend with few points and a kernel that narrows as the misfit does (graduated non-convexity)."""
    spent = 0
    widest = np.full(len(poses), np.inf)
    for _round in range(rounds):
        if widest.max() <= 3 * problem.floor:
            break  # as narrow as it gets
        # Never wider than half of the last: an outlier half of the points would hold it open.
        scales = np.minimum(2 * problem.spread(poses, count=count), 0.7 * widest)
        widest = scales = np.maximum(scales, 3 * problem.floor)
        found = problem.descend(poses, count=count, kind=GEMAN_MCCLURE, scales=scales, iterations=_COARSE_STEPS)
        poses, spent = found.poses, spent + found.iterations
    return poses, spent


def nearly(problem: DepthProblem, poses: NDArray[np.float64]) -> Descent:
    """Descend with as many points as tell one place from another, with the kernel that the residuals ask for."""
    return _within_noise(problem, poses, count=MIDDLE_POINTS, steps=_MIDDLE_STEPS)


def finest(problem: DepthProblem, found: Descent) -> Descent:
    """Descend from a pose that is nearly right with many points, then, where noise is all that is left, with all.

    What else keeps points off the surface is alike in points next to each other, and more of them tell nothing new.
    """
    last = _within_noise(problem, found.poses, count=MOST_POINTS, steps=_FINE_STEPS)
    spent = found.iterations + last.iterations
    left = problem.spread(last.poses, count=MIDDLE_POINTS)[0]
    if problem.cloud.count > MOST_POINTS and left < _NOISE_ALONE * problem.floor:
        last = _within_noise(problem, last.poses, count=problem.cloud.count, steps=_LAST_STEPS)
        spent += last.iterations
    return replace(last, iterations=spent)


def _within_noise(problem: DepthProblem, poses: NDArray[np.float64], *, count: int, steps: int) -> Descent:
    scales = _TUKEY_SIGMAS * np.minimum(problem.spread(poses, count=MIDDLE_POINTS), 10 * problem.floor)
    return problem.descend(poses, count=count, kind=TUKEY, scales=scales, iterations=steps)


def from_many(problem: DepthProblem, poses: NDArray[np.float64], known: Descent | None = None) -> Descent:
    """Descend from many starts (n, 4, 4) with few points, from the best of them with more, and from the best of all.

    Where that comes to the ``known`` pose, as near as agrees with what is seen, that is returned as it is.
    """
    spent = 0
    if len(poses) > _HUNDREDS:
        poses, spent = coarse(problem, poses, count=_FEW_POINTS, rounds=_FEW_ROUNDS)
        poses = _best(problem, poses, _KEPT_OF_HUNDREDS, asked=_MANY_POINTS)
    poses, more = coarse(problem, poses, count=_MANY_POINTS)
    spent += more
    for count in (1,) if len(poses) < _TENS else (_KEPT, 1):
        poses = _best(problem, poses, count)
        found = problem.descend(
            poses,
            count=MIDDLE_POINTS,
            kind=GEMAN_MCCLURE,
            scales=np.clip(2 * problem.spread(poses, count=MIDDLE_POINTS), 3 * problem.floor, 0.05 * problem.radius),
            iterations=_MIDDLE_STEPS,
        )
        poses, spent = found.poses, spent + found.iterations
    if known is not None and problem.distances(poses, known.poses[0])[0] < problem.tolerance:
        return replace(known, iterations=spent)
    best = nearly(problem, poses)
    return replace(best, iterations=spent + best.iterations)


def better(problem: DepthProblem, first: Descent, second: Descent) -> Descent:
    """Return the second of two descents, each of one pose, if it explains the view clearly better than the first."""
    scores = problem.scores(np.concatenate([first.poses, second.poses]))
    return second if scores[1] > CLEARLY * scores[0] else first


def _best(
    problem: DepthProblem, poses: NDArray[np.float64], count: int, *, asked: int = MIDDLE_POINTS
) -> NDArray[np.float64]:
    """Return the best poses by as many points as are asked."""
    return poses[np.argsort(-problem.scores(poses, count=asked), kind="stable")[:count]]
