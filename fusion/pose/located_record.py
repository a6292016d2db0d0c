"""What was found of a view, as it is written: ``fusion.reconstruction_files``."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from datagen.rigid import Matrix, inverse, rotation_angle_deg
from fusion.pose.ambiguity import Alternative
from fusion.pose.confidence import Confidence
from fusion.pose.refinement import Refinement
from fusion.pose.uncertainty import Uncertainty
from fusion.pose.verdict import quality
from fusion.reconstruction_files import AlternativePose, PoseUncertainty, RefinedPose, StageResult


def pose_fields(world_from_camera: Matrix) -> dict[str, Any]:
    """Return a pose both ways, by the names in ``poses.json``."""
    return {
        "world_from_camera": world_from_camera.tolist(),
        "camera_from_object": inverse(world_from_camera).tolist(),
    }


def error_fields(estimate: Matrix, truth: Matrix | None) -> dict[str, Any]:
    """Return an estimate's errors by their names in ``poses.json``, none where the truth is not known."""
    if truth is None:
        return {}
    rotation_error_deg, translation_error_m = pose_error(estimate, truth)
    return {"rotation_error_deg": rotation_error_deg, "translation_error_m": translation_error_m}


def pose_error(estimate: Matrix, truth: Matrix) -> tuple[float, float]:
    """Return the angle (degrees) and the distance (metres) between two world_from_camera poses."""
    distance = float(np.linalg.norm(estimate[:3, 3] - truth[:3, 3]))
    return rotation_angle_deg(inverse(estimate) @ truth), distance


def refined_record(results: Sequence[Refinement], confidence: Confidence, truth: Matrix | None) -> RefinedPose:
    """Return what stages of refinement came to, without a pose where the verdict is "not found"."""
    pose, evidence = results[-1].world_from_camera, confidence.evidence
    gone = confidence.verdict.answer == "not found"
    return RefinedPose(
        verdict=confidence.verdict.answer,
        reasons=list(confidence.verdict.reasons),
        quality=quality(evidence),
        evidence={name: float(value) for name, value in asdict(evidence).items() if value is not None},
        uncertainty=None if confidence.uncertainty is None else _uncertainty(confidence.uncertainty, confidence.weak),
        alternatives=[_alternative(other) for other in confidence.ambiguity.alternatives],
        stages=[_stage_result(result) for result in results],
        **({} if gone else pose_fields(pose)),
        **({} if gone else error_fields(pose, truth)),
    )


def _uncertainty(known: Uncertainty, weak: Sequence[str]) -> PoseUncertainty:
    return PoseUncertainty(
        deviations_mm=(1000 * known.deviations_m).tolist(),
        covariance=known.covariance.tolist(),
        pivot_world=np.asarray(known.pivot_world).tolist(),
        radius_m=known.radius_m,
        condition=known.condition,
        weak=list(weak),
    )


def _alternative(other: Alternative) -> AlternativePose:
    return AlternativePose(
        turn_deg=other.turn_deg,
        axis=np.round(other.axis, 4).tolist(),
        symmetric=other.symmetric,
        **pose_fields(other.world_from_camera),
    )


def _stage_result(result: Refinement) -> StageResult:
    return StageResult(
        stage=result.stage,
        converged=result.converged,
        declined=result.declined,
        reason=result.reason,
        residual=result.residual if np.isfinite(result.residual) else None,
        unit=result.unit,
        measurements=result.used,
        inlier_share=float(result.inlier_share),
        overlap=result.overlap,
        score=result.score,
    )
