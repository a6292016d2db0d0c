"""Plain faults that show without any geometry: files, images that repeat, depth that is empty or clipped."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from datagen.camera import PinholeCamera
from datagen.dataset_check.findings import Finding
from datagen.dataset_check.frame_facts import FrameFacts
from datagen.dataset_check.wording import counted, listed

EMPTY_SHARE = 0.001
CLIPPED_SHARE = 0.005
UNIFORM_DEVIATION = 1.0


def check_files(facts: Sequence[FrameFacts]) -> list[Finding]:
    """Report frames whose files are missing, damaged, or hold poses that no camera has."""
    findings = []
    missing = [each for each in facts if each.missing]
    if missing:
        findings.append(
            Finding(
                kind="missing-frames",
                severity="fault",
                message=f"Files are missing for {len(missing)} of {len(facts)} frames: "
                f"{listed([each.frame_id for each in missing])} (the first lacks: {', '.join(missing[0].missing)}).",
                remedy="Finish the rendering or recording, or leave these frames out with --frames.",
                evidence={"frames": {str(each.frame_id): list(each.missing) for each in missing}},
            )
        )
    for part, kind, what, ending in (
        ("color", "unreadable-file", "The colour images of", "cannot be read"),
        ("depth", "unreadable-file", "The depth images of", "cannot be read"),
        ("pose", "unusable-pose", "The poses of", "cannot be used"),
    ):
        broken = [each for each in facts if part in each.errors]
        if broken:
            errors = {str(each.frame_id): each.errors[part] for each in broken}  # type: ignore[index]
            findings.append(
                Finding(
                    kind=kind,
                    severity="fault",
                    message=f"{what} {len(broken)} of {len(facts)} frames {ending}: "
                    f"{listed([each.frame_id for each in broken])}. The first says: {next(iter(errors.values()))}.",
                    remedy="Copy, render or record them again, or leave these frames out with --frames.",
                    evidence={"errors": errors},
                )
            )
    reflected = [each.frame_id for each in facts if each.reflected]
    if len(reflected) > len(facts) / 2:
        findings.append(_reflection(reflected, len(facts)))
    return findings


def _reflection(reflected: list[int], count: int) -> Finding:
    return Finding(
        kind="flipped-axis",
        severity="fault",
        message=f"The rotations of {len(reflected)} of {count} poses have determinant −1: one axis of the camera, or "
        "of the world, is flipped alone, which mirrors the scene. No rigid motion does that.",
        remedy="Flip two axes, not one: from OpenGL or Blender to OpenCV camera axes negate columns 2 and 3 of "
        "world_from_camera's rotation; from a left-handed world mirror both sides of the pose.",
        evidence={"frames": reflected, "determinant": -1},
    )


def check_images(facts: Sequence[FrameFacts]) -> list[Finding]:
    """Report images that repeat, and depth that is empty or clipped."""
    findings = []
    empty = [each.frame_id for each in facts if each.depth_digest is not None and each.valid_share < EMPTY_SHARE]
    if empty:
        findings.append(
            Finding(
                kind="empty-depth",
                severity="fault",
                message=f"Depth is almost nowhere (in less than {EMPTY_SHARE:.1%} of the pixels) in {len(empty)} of "
                f"{len(facts)} frames: {listed(empty)}.",
                remedy="Look at these frames: is the object out of view, out of range, or the depth not written?",
                evidence={"frames": empty, "valid_share_below": EMPTY_SHARE},
            )
        )
    uniform = [e.frame_id for e in facts if e.color_digest is not None and e.color_deviation < UNIFORM_DEVIATION]
    if uniform:
        findings.append(
            Finding(
                kind="uniform-color",
                severity="note",
                message=f"The colour images of {len(uniform)} of {len(facts)} frames are of one colour: "
                f"{listed(uniform)}.",
                remedy="Look at these frames: lights, exposure, a lens cap?",
                evidence={"frames": uniform},
            )
        )
    return findings + _frozen_images(facts) + _clipped(facts)


def _frozen_images(facts: Sequence[FrameFacts]) -> list[Finding]:
    """Report frames that repeat colour and depth, bit by bit, of the frame before while the pose moves on."""
    frozen = []
    for before, after in pairwise(facts):
        images = (after.color_digest, after.depth_digest)
        if None in images or images != (before.color_digest, before.depth_digest) or after.valid_share < EMPTY_SHARE:
            continue
        if before.pose is None or after.pose is None or not np.allclose(before.pose, after.pose, atol=1e-6):
            frozen.append(after.frame_id)
    if not frozen:
        return []
    return [
        Finding(
            kind="frozen-frames",
            severity="fault",
            message=f"The images of the frame before are repeated bit by bit, while the poses move on, in "
            f"{counted(len(frozen), 'frame')}: {listed(frozen)}.",
            remedy="Leave them out: the images do not belong to these poses.",
            evidence={"frames": frozen},
        )
    ]


def _clipped(facts: Sequence[FrameFacts]) -> list[Finding]:
    """Report depth that piles up at one largest value in frames that look different ways.

    A wall seen straight on piles up too, but not at the same value from another direction.
    """
    seen = [each for each in facts if each.valid_share >= EMPTY_SHARE]
    if len(seen) < 3:
        return []
    limit = max(each.farthest for each in seen)
    piled = [each for each in seen if each.farthest == limit and each.farthest_share > CLIPPED_SHARE]
    poses = [each.pose for each in piled if each.pose is not None]
    if len(piled) < max(3, len(seen) // 10) or len(poses) < 3:
        return []
    forward = np.array([pose[:3, 2] for pose in poses])
    if np.linalg.norm(forward.mean(axis=0)) > np.cos(np.radians(2)):
        return []
    share = float(np.median([each.farthest_share for each in piled]))
    return [
        Finding(
            kind="clipped-depth",
            severity="fault",
            message=f"In {len(piled)} of {len(seen)} frames depth piles up at its largest value, {limit:.4g} m "
            f"({share:.1%} of the pixels there, from different directions): it is clipped, and a surface that is not "
            "there is recorded.",
            remedy="Write 0 (invalid) beyond the range, or choose a depth scale that fits the scene.",
            evidence={"frames": [each.frame_id for each in piled], "limit_m": limit, "median_share": share},
        )
    ]


def check_intrinsics(camera: PinholeCamera) -> list[Finding]:
    """Report intrinsics that no ordinary camera has."""
    reasons = []
    if not 0 <= camera.cx <= camera.width - 1 or not 0 <= camera.cy <= camera.height - 1:
        reasons.append(f"the principal point ({camera.cx:.4g}, {camera.cy:.4g}) lies outside of the image")
    if not 0.5 <= camera.fx / camera.fy <= 2:
        reasons.append(f"fx {camera.fx:.4g} and fy {camera.fy:.4g} differ more than twofold")
    side = max(camera.width, camera.height)
    if not 0.2 <= max(camera.fx, camera.fy) / side <= 20:
        degrees = 2 * np.degrees(np.arctan(side / 2 / max(camera.fx, camera.fy)))
        reasons.append(f"the field of view is {degrees:.3g}°")
    if not reasons:
        return []
    return [
        Finding(
            kind="implausible-intrinsics",
            severity="fault",
            message=f"The intrinsics can hardly be right for images of {camera.width}×{camera.height} pixels: "
            f"{'; '.join(reasons)}.",
            remedy="Give them in pixels, for the images' own size (not that before a resize or crop).",
            evidence={"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy},
        )
    ]
