"""All that is known of a refined pose: evidence, verdict, uncertainty, and what else would explain the view."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fusion.pose.ambiguity import Ambiguity, find_ambiguity
from fusion.pose.depth_uncertainty import depth_uncertainty
from fusion.pose.evidence import Evidence, gather_evidence
from fusion.pose.pose_model import PoseModel
from fusion.pose.query import Query
from fusion.pose.refinement import Refinement
from fusion.pose.uncertainty import Uncertainty
from fusion.pose.verdict import Verdict, judge


@dataclass(frozen=True, kw_only=True, eq=False)
class Confidence:
    """What speaks for and against the last stage's pose; ``uncertainty`` is None where nothing was found."""

    verdict: Verdict
    evidence: Evidence
    uncertainty: Uncertainty | None = None
    ambiguity: Ambiguity = field(default_factory=Ambiguity)

    @property
    def weak(self) -> tuple[str, ...]:
        """The directions that are not fixed, in words."""
        known = () if self.uncertainty is None else self.uncertainty.weak
        # What can be moved far is told with how far.
        told = [name.partition(", from ")[0] for name in self.ambiguity.weak]
        return (*self.ambiguity.weak, *(name for name in known if name not in told))


def assess(model: PoseModel, query: Query, results: Sequence[Refinement]) -> Confidence:
    """Say what is known of the pose that stages of refinement have come to, one after the other.

    Where the last stage declined, the pose is that of the one before it.
    """
    last = results[-1]
    pose = last.world_from_camera
    acted = next((result for result in reversed(results) if not result.declined), last)
    evidence = gather_evidence(model, query, pose)
    verdict = judge(acted, evidence)
    if last.declined and last.reason not in verdict.reasons:
        verdict = Verdict(verdict.answer, (*verdict.reasons, f"{last.stage}: {last.reason}"))
    if verdict.answer == "not found":
        return Confidence(verdict=verdict, evidence=evidence)
    known = depth_uncertainty(model, query, pose) if query.depth is not None else None
    known = known or acted.uncertainty
    ambiguity = Ambiguity() if known is None else find_ambiguity(model, query, pose, known)
    confidence = Confidence(verdict=verdict, evidence=evidence, uncertainty=known, ambiguity=ambiguity)
    return Confidence(
        verdict=_with_ambiguity(verdict, confidence), evidence=evidence, uncertainty=known, ambiguity=ambiguity
    )


def _with_ambiguity(verdict: Verdict, confidence: Confidence) -> Verdict:
    """Return the verdict with the directions that are not fixed, doubtful where another side would do as well."""
    answer, reasons = verdict.answer, list(verdict.reasons)
    reasons += [f"not fixed: {direction}" for direction in confidence.weak]
    others = [other for other in confidence.ambiguity.alternatives if not other.symmetric]
    if others:
        turns = ", ".join(f"{other.turn_deg:.0f}° about {_axis(other.axis)}" for other in others[:4])
        reasons.append(f"the view fits as well with the model turned by {turns}")
        answer = "doubtful" if answer == "found" else answer
    symmetries = len(confidence.ambiguity.alternatives) - len(others)
    if symmetries:
        reasons.append(f"the model is symmetric: {symmetries} other poses mean the same")
    return Verdict(answer, tuple(reasons))


def _axis(axis: NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in axis) + ")"
