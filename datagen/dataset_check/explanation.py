"""A correction in plain words: the fault that it mends, the remedy, and the numbers before and after."""

from typing import Any

import numpy as np

from datagen.camera import PinholeCamera
from datagen.dataset_check.correction import Correction
from datagen.dataset_check.diagnosis import Verdict
from datagen.dataset_check.findings import AMBIGUOUS, Finding, Severity
from datagen.dataset_check.fitting import Judge
from datagen.dataset_check.wording import length

HALF_PIXEL_TOLERANCE = 0.15

FAULT_NAMES = {
    "principal-point": "a shifted principal point (half a pixel, say)",
    "half-pixel": "a principal point half a pixel off",
    "focal-length": "a wrong focal length",
    "depth-scale": "a wrong depth scale",
    "ray-distance": "ray distance in place of planar depth",
    "flipped-axis": "flipped camera axes",
    "inverse-pose": "inverted poses",
    "transposed-rotation": "transposed rotations",
    "time-shift": "poses shifted by some frames",
}


def family(kind: str) -> str:
    """Return the kind of fault that a hypothesis belongs to."""
    return "focal-length" if kind.startswith("focal-length") else kind


def findings_of(judge: Judge, verdict: Verdict, camera: PinholeCamera, severity: Severity) -> list[Finding]:
    """Return what the best hypothesis of a verdict says, a finding for each thing that it corrects.

    One finding 'cannot tell' where others explain the residuals as well.
    """
    evidence = evidence_of(judge, verdict)
    rivals = sorted({family(rival.kind) for rival in verdict.rivals} - {family(verdict.best.kind)})
    if rivals:
        if severity == "note":
            return []
        names = [FAULT_NAMES[kind] for kind in [family(verdict.best.kind), *rivals]]
        return [
            Finding(
                kind=AMBIGUOUS,
                severity=severity,
                message=f"Something is wrong, but the frames cannot tell what: {'; or '.join(names)} explain it "
                f"equally well. {numbers(evidence)}",
                remedy="Look at what is known of these, or record more varied views: depth in relief, the camera "
                "turning and moving.",
                evidence=evidence | {"candidates": [family(verdict.best.kind), *rivals]},
            )
        ]
    before, after = verdict.base.correction, verdict.best.correction
    return [
        Finding(
            kind=kind,
            severity=severity,
            message=f"{message} {numbers(evidence)}",
            remedy=remedy,
            evidence=evidence | sizes,
        )
        for kind, message, remedy, sizes in _differences(before, after, camera)
    ]


def evidence_of(judge: Judge, verdict: Verdict) -> dict[str, Any]:
    """Return the residuals before and after by kind of evidence, lengths in metres."""
    result: dict[str, Any] = {"gain": verdict.gain, "significance": verdict.significance}
    for each in judge.evidence:
        for name, judged in (("before", verdict.base), ("after", verdict.best)):
            residuals = each.residuals(judged.correction)
            result.setdefault(each.name, {"blocks": len(residuals.known)})[name] = {
                "median_m": residuals.median_m if np.isfinite(residuals.median_m) else None,
                "agreement": residuals.agreement,
                "overlap": residuals.overlap,
            }
    return result


def numbers(evidence: dict[str, Any]) -> str:
    """Return the residuals before and after in a sentence for each kind of evidence."""
    what = {"frames": "Frames reprojected into each other", "mesh": "Frames held against the true mesh"}
    sentences = []
    for name, subject in what.items():
        if name in evidence:
            before, after = evidence[name]["before"], evidence[name]["after"]
            sentences.append(f"{subject} disagree by {_residual(before)}; after the correction by {_residual(after)}.")
    return " ".join(sentences)


def _residual(numbers: dict[str, float | None]) -> str:
    if numbers["median_m"] is None:
        return "everything (they do not meet at all)"
    return f"{length(numbers['median_m'])} in the median ({numbers['overlap']:.0%} of the samples meet a surface)"


def _differences(
    before: Correction, after: Correction, camera: PinholeCamera
) -> list[tuple[str, str, str, dict[str, Any]]]:
    """Return (kind, message, remedy, sizes) of each thing in which two corrections differ."""
    found = []
    if after.pose_form != before.pose_form:
        found.append(_pose_form(after))
    if after.axes != before.axes:
        found.append(_axes(after))
    if after.pose_shift != before.pose_shift:
        found.append(_pose_shift(after.pose_shift))
    if after.ray_distance != before.ray_distance:
        found.append(
            (
                "ray-distance",
                "Depth is the distance along the ray, not planar z: it grows towards the image's corners.",
                "Divide each pixel's depth by the length of its ray, √(1 + ((u − cx)/fx)² + ((v − cy)/fy)²).",
                {},
            )
        )
    if after.principal_shift_px != before.principal_shift_px:
        found.append(_principal_point(before, after, camera))
    if after.focal_factor != before.focal_factor:
        found.append(_focal_length(before, after, camera))
    if after.depth_factor != before.depth_factor:
        found.append(_depth_scale(after.depth_factor / before.depth_factor))
    return found


def _pose_form(after: Correction) -> tuple[str, str, str, dict[str, Any]]:
    if after.pose_form == "inverse":
        return (
            "inverse-pose",
            "The poses are inverted: camera_from_world is stored where world_from_camera is expected.",
            "Invert every pose.",
            {},
        )
    return (
        "transposed-rotation",
        "The poses' rotations are transposed while their translations are right.",
        "Transpose every rotation; a matrix in column-major order, or a quaternion's conjugate, would explain it.",
        {},
    )


def _axes(after: Correction) -> tuple[str, str, str, dict[str, Any]]:
    names = [name for name, sign in zip("xyz", after.axes, strict=True) if sign < 0]
    sizes = {"axes": list(after.axes), "mirrored_image": after.mirrored_image}
    flipped = f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'} flipped"
    if after.axes == (1, -1, -1):
        message = (
            "The camera axes are those of OpenGL and Blender (y up, z backwards), not OpenCV's (y down, z forwards)."
        )
        return "flipped-axis", message, "Negate columns 2 and 3 of every pose's rotation.", sizes
    if after.axes[2] > 0 and (after.mirrored_image or np.prod(after.axes) < 0):
        ways = [way for way, name in (("columns", "x"), ("rows", "y")) if name in names]
        return (
            "flipped-axis",
            f"The images' {' and '.join(ways)} run backwards against the poses: the camera's {flipped}.",
            "Flip the images (colour and depth), or the poses' world and camera axes alike.",
            sizes,
        )
    columns = " and ".join(str("xyz".index(name) + 1) for name in names)
    return (
        "flipped-axis",
        f"The camera axes are not OpenCV's (x right, y down, z forwards): {flipped}.",
        f"Negate column{'s' if len(names) > 1 else ''} {columns} of every pose's rotation.",
        sizes,
    )


def _pose_shift(shift: int) -> tuple[str, str, str, dict[str, Any]]:
    frames = f"{abs(shift)} frame{'' if abs(shift) == 1 else 's'}"
    way = "later" if shift > 0 else "earlier"
    return (
        "time-shift",
        f"Poses and images are shifted against each other: an image's pose stands {frames} {way} in the sequence.",
        f"Give each image the pose that is now {frames} {way}; look for a delay between the two clocks.",
        {"pose_shift_frames": shift},
    )


def _principal_point(
    before: Correction, after: Correction, camera: PinholeCamera
) -> tuple[str, str, str, dict[str, Any]]:
    shift = np.subtract(after.principal_shift_px, before.principal_shift_px)
    cx, cy = after.intrinsics(camera)[2:]
    size = np.abs(shift)
    half, none = np.abs(size - 0.5) < HALF_PIXEL_TOLERANCE, size < HALF_PIXEL_TOLERANCE
    is_half = bool((half | none).all() and half.any())
    message = (
        f"The principal point is {'half a pixel' if is_half else f'{np.hypot(*shift):.2f} px'} off: moving it by "
        f"({shift[0]:+.2f}, {shift[1]:+.2f}) px makes the frames agree."
    )
    reason = " Pixel centres at +0.5 and at integers were confused." if is_half else ""
    return (
        "half-pixel" if is_half else "principal-point",
        message + reason,
        f"Set cx = {cx:.2f}, cy = {cy:.2f} px.",
        {"shift_px": shift.tolist()},
    )


def _focal_length(before: Correction, after: Correction, camera: PinholeCamera) -> tuple[str, str, str, dict[str, Any]]:
    factor_x, factor_y = np.divide(after.focal_factor, before.focal_factor)
    fx, fy = after.intrinsics(camera)[:2]
    which = "The focal lengths are" if factor_x != 1 and factor_y != 1 else "fx is" if factor_x != 1 else "fy is"
    factor = factor_x if factor_x != 1 else factor_y
    return (
        "focal-length",
        f"{which} {abs(1 / factor - 1):.1%} too {'large' if factor < 1 else 'small'}.",
        f"Set fx = {fx:.2f}, fy = {fy:.2f} px.",
        {"fx_factor": float(factor_x), "fy_factor": float(factor_y)},
    )


def _depth_scale(factor: float) -> tuple[str, str, str, dict[str, Any]]:
    off = f"{abs(1 / factor - 1):.1%}" if 0.5 < factor < 2 else f"a factor of {max(factor, 1 / factor):.4g}"
    return (
        "depth-scale",
        f"Depth is too {'large' if factor < 1 else 'small'} by {off} against the translations of the poses.",
        f"Multiply the depth scale by {factor:.4g}; or, if the poses are at fault, divide their translations by it.",
        {"depth_factor": factor},
    )
