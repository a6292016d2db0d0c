"""Whether a refined pose is to be believed: found, doubtful, or not found, with the reasons.

What speaks is how well the pose explains the view, both ways together (``Refinement.score``). The bounds come from a
bunny, a box, a ball and a torus held against Suzanne, and three objects of real frames against each other: right poses
scored 0.65 to 0.99, wrong objects 0.1 to 0.73. They were read off these data and not tried on others.
"""

from dataclasses import dataclass
from typing import Literal

from fusion.pose.refinement import Refinement

Answer = Literal["found", "doubtful", "not found"]

FOUND_FROM, DOUBTFUL_FROM = 0.75, 0.6
"""Scores: in those data every wrong object stayed below the first, every right one above the second."""

_FOUND_OVERLAP, _DOUBTFUL_OVERLAP = 0.9, 0.8
_FEWEST_ON_OUTLINE, _FEWEST_MATCHES = 0.8, 30


@dataclass(frozen=True)
class Verdict:
    """``answer``, and ``reasons`` in words, none where it is found without reserve."""

    answer: Answer
    reasons: tuple[str, ...] = ()


def judge(refinement: Refinement) -> Verdict:
    """Say whether a stage's pose is to be believed.

    With depth by its score; of a silhouette by the masks' overlap, which cannot tell objects of one outline apart; of
    features by their number. Directions that nothing fixes are named, but do not make a pose doubtful: that an object
    is symmetric is no fault of the pose.
    """
    if refinement.declined:
        return Verdict("not found", (refinement.reason,))
    by_stage = {"depth": _by_depth, "silhouette": _by_silhouette, "epipolar": _by_features}
    answer, reasons = by_stage[refinement.stage](refinement)
    if not refinement.converged:
        answer = "doubtful" if answer == "found" else answer
        reasons = (*reasons, refinement.reason)
    if refinement.uncertainty is not None:
        reasons = (*reasons, *(f"not fixed: {direction}" for direction in refinement.uncertainty.weak))
    return Verdict(answer, reasons)


def _graded(value: float, found_from: float, doubtful_from: float) -> Answer:
    return "found" if value >= found_from else "doubtful" if value >= doubtful_from else "not found"


def _by_depth(refinement: Refinement) -> tuple[Answer, tuple[str, ...]]:
    assert refinement.score is not None, "a refinement with depth has a score"
    answer = _graded(refinement.score, FOUND_FROM, DOUBTFUL_FROM)
    if answer == "found":
        return answer, ()
    overlap = refinement.overlap or 0.0
    return answer, (
        f"the model explains {refinement.inlier_share:.0%} of the query's points, and the query shows {overlap:.0%} of"
        f" what should be seen of the model: score {refinement.score:.2f}, at least {FOUND_FROM} is sure",
    )


def _by_silhouette(refinement: Refinement) -> tuple[Answer, tuple[str, ...]]:
    overlap = refinement.overlap or 0.0
    answer = _graded(overlap, _FOUND_OVERLAP, _DOUBTFUL_OVERLAP)
    if answer == "found" and refinement.inlier_share < _FEWEST_ON_OUTLINE:
        answer = "doubtful"
    if answer == "found":
        return answer, ()
    return answer, (
        f"the silhouettes overlap by {overlap:.0%}, and {refinement.inlier_share:.0%} of the outline is within a pixel",
    )


def _by_features(refinement: Refinement) -> tuple[Answer, tuple[str, ...]]:
    if refinement.used >= _FEWEST_MATCHES:
        return "found", ()
    return "doubtful", (f"only {refinement.used} matches, at least {_FEWEST_MATCHES} are sure",)
