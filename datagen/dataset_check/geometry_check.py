"""Frames held against each other and against the true mesh: which structural fault do they have, if any?"""

from pathlib import Path
from typing import Any

import numpy as np

from datagen.dataset import Dataset
from datagen.dataset_check.blind_spots import BLIND_SPOT_NAMES, blind_spots
from datagen.dataset_check.correction import Correction
from datagen.dataset_check.depth_noise import measure_depth_noise
from datagen.dataset_check.diagnosis import LEAST_GAIN, Verdict, compare
from datagen.dataset_check.explanation import FAULT_NAMES, findings_of
from datagen.dataset_check.findings import AMBIGUOUS, CANNOT_TELL, Finding
from datagen.dataset_check.fitting import Judge
from datagen.dataset_check.frame_facts import FrameFacts, typical_depth
from datagen.dataset_check.mesh_evidence import MeshEvidence
from datagen.dataset_check.pair_evidence import PairEvidence
from datagen.dataset_check.pair_selection import choose_pairs
from datagen.dataset_check.ray_casting import load_mesh_rays
from datagen.dataset_check.residuals import Evidence
from datagen.dataset_check.views import Views, inverse_depth, smooth_pixels
from datagen.dataset_check.wording import length
from datagen.errors import InputError

ANCHORS = 12
SAMPLES = 256
MOST_FAULTS = 3
LEAST_AGREEMENT = 0.35
"""Share of the samples that meet a surface whose depth must be about right for frames to belong together."""

LEAST_OVERLAP = 0.05
LEAST_GEOMETRY_DEPTH = 0.01
"""Frames with depth in a smaller share of their pixels say nothing about geometry."""


def check_geometry(
    dataset: Dataset, facts: list[FrameFacts], rng: np.random.Generator
) -> tuple[list[Finding], dict[str, Any]]:
    """Return the structural faults of a dataset, and what that rests on. ``facts`` are all frames, in order."""
    usable = [each for each in facts if each.pose is not None and each.valid_share >= LEAST_GEOMETRY_DEPTH]
    findings: list[Finding] = []
    mesh_path = dataset.ground_truth_mesh
    views, pairs = _load_views(dataset, usable)
    evidence: list[Evidence] = []
    if len(pairs):
        frames = PairEvidence(views, pairs, samples=SAMPLES, rng=rng)
        evidence += [frames] if len(frames.pairs) else []
    if mesh_path is not None:
        mesh, problem = _mesh_evidence(mesh_path, views, rng)
        evidence += [mesh] if mesh is not None else []
        findings += [problem] if problem is not None else []
    if not evidence:
        return [*findings, _nothing_to_compare()], {"frames_compared": 0, "pairs": 0, "mesh": False}
    judge = Judge(evidence)
    verdict, named = _rounds(judge, dataset, frames=len(usable))
    findings += named
    if not any(finding.severity == "fault" for finding in named):
        findings += _unexplained(judge, verdict)
        if not any(finding.severity == "fault" for finding in findings):
            findings += _blindness(judge, verdict, has_mesh=len(evidence) > 1)
    return findings, _basis(judge, views, verdict)


def _load_views(dataset: Dataset, usable: list[FrameFacts]) -> tuple[Views, np.ndarray]:
    poses = np.array([each.pose for each in usable]).reshape(-1, 4, 4)
    pairs = choose_pairs(poses, anchors=ANCHORS, depth=typical_depth(usable))
    spread = np.linspace(0, len(usable) - 1, min(2 * ANCHORS, len(usable))).round().astype(np.int64)
    positions = np.unique(pairs) if len(pairs) else np.unique(spread)
    depth = np.array([dataset.depth(usable[i].frame_id) for i in positions])
    smooth = np.array([smooth_pixels(image) for image in depth])
    views = Views(
        camera=dataset.camera,
        poses=poses,
        positions=positions,
        depth=depth,
        smooth=smooth,
        noise=measure_depth_noise(inverse_depth(depth), smooth, depth_scale=dataset.depth_scale),
    )
    return views, np.searchsorted(positions, pairs)


def _mesh_evidence(path: Path, views: Views, rng: np.random.Generator) -> tuple[MeshEvidence | None, Finding | None]:
    try:
        mesh = load_mesh_rays(path)
    except InputError as error:
        return None, Finding(
            kind="unreadable-mesh",
            severity="fault",
            message=f"The ground-truth mesh cannot be used: {error}.",
            remedy="Copy or write it again, or take it out of dataset.json.",
            evidence={"mesh": str(path)},
        )
    if mesh is None:
        return None, Finding(
            kind="mesh-not-used",
            severity="note",
            message="The ground-truth mesh was not looked at: embreex, which casts rays, is not installed here.",
            remedy="pip install embreex (there are wheels for Linux on x86-64, macOS and Windows).",
            evidence={"mesh": str(path)},
        )
    evidence = MeshEvidence(views, mesh, samples=SAMPLES, rng=rng)
    return (evidence if len(evidence.views) else None), None


def _rounds(judge: Judge, dataset: Dataset, *, frames: int) -> tuple[Verdict, list[Finding]]:
    """Name one fault after the other, each on top of the corrections of those before."""
    findings: list[Finding] = []
    base = Correction()
    for _ in range(MOST_FAULTS):
        verdict = compare(judge, base, frames=frames)
        if not verdict.is_fault:
            break
        found = findings_of(judge, verdict, dataset.camera, "fault")
        findings += found
        base = verdict.best.correction
        if any(finding.kind == AMBIGUOUS for finding in found) or _is_explained(judge, base):
            return verdict, findings
    if not findings and verdict.is_notable:
        findings += findings_of(judge, verdict, dataset.camera, "note")
    return verdict, findings


def _is_explained(judge: Judge, correction: Correction) -> bool:
    """Tell whether what a correction leaves is noise, so that there is no need to look for another fault."""
    return all(each.residuals(correction).median_sigmas < 1 for each in judge.evidence)


def _unexplained(judge: Judge, verdict: Verdict) -> list[Finding]:
    """Report frames, or a mesh, that do not fit and for which no hypothesis has a reason."""
    residuals = {each.name: each.residuals(verdict.base.correction) for each in judge.evidence}
    fits = {
        name: each.agreement >= LEAST_AGREEMENT and each.overlap >= LEAST_OVERLAP for name, each in residuals.items()
    }
    numbers = {
        name: {"agreement": each.agreement, "overlap": each.overlap, "blocks": len(each.known)}
        for name, each in residuals.items()
    }
    if "frames" in fits and not fits["frames"] and not fits.get("mesh", False):
        frames = residuals["frames"]
        return [
            Finding(
                kind="inconsistent-geometry",
                severity="fault",
                message=f"Frames reprojected into each other do not fit: of the {frames.overlap:.0%} of the samples "
                f"that meet a surface only {frames.agreement:.0%} have about its depth, and none of the known faults "
                "explains it.",
                remedy="Poses and images do not belong together: look at their order, the tracking, things that move.",
                evidence=numbers,
            )
        ]
    if not fits.get("mesh", True):
        mesh = residuals["mesh"]
        return [
            Finding(
                kind="mesh-mismatch",
                severity="fault",
                message=f"The ground-truth mesh is not what the frames show: {mesh.overlap:.0%} of the samples meet "
                f"it, and {mesh.agreement:.0%} of those at about the right depth"
                + (", while the frames agree with each other." if fits.get("frames", False) else "."),
                remedy="The mesh has other axes, another unit or origin than the poses, or belongs to another scene.",
                evidence=numbers,
            )
        ]
    return []


def _blindness(judge: Judge, verdict: Verdict, *, has_mesh: bool) -> list[Finding]:
    kinds = blind_spots(judge, verdict.base, verdict.sigma_factor, least_gain=LEAST_GAIN)
    if not kinds:
        return []
    names = ", ".join(BLIND_SPOT_NAMES[kind] for kind in kinds)
    return [
        Finding(
            kind=CANNOT_TELL,
            severity="note",
            message=f"These frames {'and the mesh ' if has_mesh else ''}would hardly show: {names}. "
            "That they are right is not confirmed.",
            remedy="Views with more relief, of a camera that turns and moves unevenly"
            + ("." if has_mesh else ", or a ground-truth mesh, would tell."),
            evidence={"kinds": kinds},
        )
    ]


def _nothing_to_compare() -> Finding:
    return Finding(
        kind=CANNOT_TELL,
        severity="note",
        message="No two frames see the same from clearly different places, and there is no ground-truth mesh: whether "
        "poses, intrinsics and depth fit together cannot be told.",
        remedy="Choose more frames, or record while the camera moves and turns.",
        evidence={"kinds": list(FAULT_NAMES)},
    )


def _basis(judge: Judge, views: Views, verdict: Verdict) -> dict[str, Any]:
    basis: dict[str, Any] = {
        "frames_compared": len(views.positions),
        "depth_noise_m": float(views.noise.sigma(np.array(views.median_depth))),
        "median_depth_m": views.median_depth,
        "noise_factor": verdict.sigma_factor,
    }
    for each in judge.evidence:
        residuals = each.residuals(verdict.best.correction if verdict.is_fault else verdict.base.correction)
        median = residuals.median_m
        basis[each.name] = {
            "blocks": len(residuals.known),
            "median_m": median if np.isfinite(median) else None,
            "median": length(median) if np.isfinite(median) else None,
            "agreement": residuals.agreement,
            "overlap": residuals.overlap,
        }
    return basis
