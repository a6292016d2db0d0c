"""Whether a pose is to be believed: found, doubtful, or not found, with the reasons.

What speaks is the evidence of the view itself (``fusion.pose.evidence``), whatever stage found the pose. How the bounds
were chosen, and how often they are right on objects that they were not chosen on, is in benchmarks/RESULTS.md.
"""

from dataclasses import dataclass

from fusion.pose.evidence import Evidence
from fusion.pose.refinement import Refinement
from fusion.reconstruction_files import Answer

FOUND_FROM, DOUBTFUL_FROM = 0.85, 0.55
"""Of the quality of a query with depth."""
OUTLINE_FOUND_FROM, OUTLINE_DOUBTFUL_FROM = 0.97, 0.85
"""Of the quality of a query with a mask alone."""

FEWEST_PIXELS = 60
_NEAREST_COST = 0.4
"""Of a query's alignment with the nearest view, up to which it is taken for right as long as nothing refines it."""


@dataclass(frozen=True)
class Verdict:
    """``answer``, and ``reasons`` in words, none where it is found without reserve."""

    answer: Answer
    reasons: tuple[str, ...] = ()


def quality(evidence: Evidence) -> float:
    """Return how well a pose explains a view, 0 to 1: the product of all shares that there are.

    A right pose has all of them near 1; a wrong object fails at least one of them, and often each in part.
    """
    if evidence.pixels == 0 or (evidence.agreeing is None and evidence.covered is None):
        return 0.0
    product = 1.0 if evidence.agreeing is None else evidence.agreeing
    for share in (evidence.covered, evidence.filled, evidence.slopes):
        product *= 1.0 if share is None else share
    if evidence.free is not None:
        product *= 1 - evidence.free
    return float(product)


def judge(refinement: Refinement, evidence: Evidence) -> Verdict:
    """Say whether the pose of a refinement is to be believed, given what the view says of it.

    A mask alone cannot tell objects of one outline apart. Directions that nothing fixes do not make a pose doubtful:
    that an object is symmetric is no fault of the pose.
    """
    pixels = evidence.depth_pixels if refinement.stage == "depth" else evidence.pixels
    if pixels < FEWEST_PIXELS:
        reason = f"{pixels} pixels are there to compare, fewer than {FEWEST_PIXELS}"
        return Verdict("not found", (refinement.reason or reason,))
    with_depth = evidence.agreeing is not None
    found_from, doubtful_from = (
        (FOUND_FROM, DOUBTFUL_FROM) if with_depth else (OUTLINE_FOUND_FROM, OUTLINE_DOUBTFUL_FROM)
    )
    value = quality(evidence)
    answer: Answer = "found" if value >= found_from else "doubtful" if value >= doubtful_from else "not found"
    reasons = () if answer == "found" else (f"{_explained(evidence)}: quality {value:.2f}, {found_from} is sure",)
    if not refinement.converged:
        answer = "doubtful" if answer == "found" else answer
        reasons = (*reasons, refinement.reason)
    return Verdict(answer, reasons)


def judge_nearest(cost: float, *, ambiguous: bool) -> Verdict:
    """Say whether a nearest pose that nothing refines is to be believed, by the cost of its alignment, 0 to 1."""
    reasons = []
    if cost > _NEAREST_COST:
        reasons.append(f"the view agrees poorly with the nearest one, cost {cost:.2f}; refine it to be sure")
    if ambiguous:
        reasons.append("the view looks alike from another side")
    return Verdict("doubtful" if reasons else "found", tuple(reasons))


def _explained(evidence: Evidence) -> str:
    """Say in words what the model explains of the view, and what not."""
    parts = []
    if evidence.covered is not None:
        parts.append(
            f"the model covers {evidence.covered:.0%} of the mask, and {evidence.filled or 0:.0%} of the model is in it"
        )
    if evidence.agreeing is not None:
        where = "the object's" if evidence.covered is not None else "all (no mask tells the object's)"
        parts.append(f"depth is the model's at {evidence.agreeing:.0%} of {where} pixels")
    if evidence.free:
        parts.append(f"the view looks through {evidence.free:.0%} of what should be seen of the model")
    if evidence.slopes is not None and evidence.slopes < 0.9:
        parts.append(f"{evidence.slopes:.0%} of it slopes as the model does")
    return "; ".join(parts)
