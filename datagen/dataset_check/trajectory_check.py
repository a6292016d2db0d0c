"""Poses of a sequence held against each other: jumps, poses that stand still, gaps in the frames' numbers."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from datagen.dataset_check.findings import Finding
from datagen.dataset_check.frame_facts import FrameFacts
from datagen.dataset_check.wording import counted, listed

JUMP_FACTOR = 4.0
"""Between a jump and the longest of the other steps."""

MOST_JUMPS = 0.05
"""Beyond this share of the frames, and two, the camera is meant to jump."""

CHANGED_DEPTH = 0.02
"""Relative change of depth, in the median over the image, by which something has clearly moved."""


def check_trajectory(facts: Sequence[FrameFacts]) -> list[Finding]:
    """Report jumps, frozen poses and gaps; ``facts`` are the frames in order."""
    usable = [each for each in facts if each.is_usable]
    return [*_gaps(facts), *(_jumps(usable) + _frozen_poses(usable) if len(usable) >= 8 else [])]


def _gaps(facts: Sequence[FrameFacts]) -> list[Finding]:
    numbers = np.array([each.frame_id for each in facts])
    if len(numbers) < 3:
        return []
    steps = np.diff(numbers)
    usual = int(np.median(steps))
    wide = np.flatnonzero(steps > usual)
    if usual < 1 or not 0 < len(wide) <= max(1, len(steps) // 4):
        return []
    lost = int((steps[wide] // usual - 1).sum())
    return [
        Finding(
            kind="frame-gaps",
            severity="note",
            message=f"The frames' numbers go up by {usual}, but jump after "
            f"{listed([int(numbers[i]) for i in wide])}: probably {counted(lost, 'frame')} lost.",
            remedy="Nothing, if they were left out on purpose.",
            evidence={"after": [int(numbers[i]) for i in wide], "lost": lost, "usual_step": usual},
        )
    ]


def _jumps(usable: Sequence[FrameFacts]) -> list[Finding]:
    poses = np.array([each.pose for each in usable])
    steps = np.diff([each.frame_id for each in usable])
    depth = float(np.median([each.farthest for each in usable]))
    translation = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / np.maximum(steps, 1)
    cosine = (np.einsum("nij,nij->n", poses[1:, :3, :3], poses[:-1, :3, :3]) - 1) / 2
    rotation = np.degrees(np.arccos(np.clip(cosine, -1, 1))) / np.maximum(steps, 1)
    jumped = _beyond(translation, 0.02 * depth) | _beyond(rotation, 2.0)
    at = np.flatnonzero(jumped)
    if not 0 < len(at) <= _most_jumps(len(steps)):
        return []
    images = np.array([_depth_change(before, after) for before, after in pairwise(usable)])
    steady = images[at] <= 2 * np.median(images[~jumped]) + 0.01
    frames = [usable[i + 1].frame_id for i in at]
    evidence = {
        "frames": frames,
        "translation_m": [float(translation[i]) for i in at],
        "rotation_deg": [float(rotation[i]) for i in at],
        "usual_translation_m": float(np.median(translation)),
        "usual_rotation_deg": float(np.median(rotation)),
        "relative_depth_change": [float(images[i]) for i in at],
        "usual_relative_depth_change": float(np.median(images[~jumped])),
    }
    worst = int(at[np.argmax(translation[at] / (np.median(translation) + 1e-9))])
    message = (
        f"The trajectory jumps at {counted(len(frames), 'frame')}: {listed(frames)}. At frame "
        f"{usable[worst + 1].frame_id} the camera moves {translation[worst]:.3g} m and turns {rotation[worst]:.3g}° "
        f"within a frame, usually {np.median(translation):.3g} m and {np.median(rotation):.3g}°."
    )
    if steady.any():
        return [
            Finding(
                kind="pose-jump",
                severity="fault",
                message=f"{message} The images do not jump with it: these poses are wrong.",
                remedy="Leave these frames out, or estimate their poses again.",
                evidence=evidence,
            )
        ]
    return [
        Finding(
            kind="trajectory-jump",
            severity="note",
            message=f"{message} The images change with it.",
            remedy="Nothing, if the recording was cut there.",
            evidence=evidence,
        )
    ]


def _beyond(steps: NDArray[np.float64], least: float) -> NDArray[np.bool_]:
    others = np.sort(steps)[: -_most_jumps(len(steps))]
    return steps > max(JUMP_FACTOR * float(others[-1]), least)


def _most_jumps(steps: int) -> int:
    return max(2, int(MOST_JUMPS * steps))


def _depth_change(before: FrameFacts, after: FrameFacts) -> float:
    """Return the median relative change of depth where both frames have it; what appears or vanishes counts as 1."""
    assert before.thumbnail is not None
    assert after.thumbnail is not None
    a, b = before.thumbnail, after.thumbnail
    either = (a > 0) | (b > 0)
    if not either.any():
        return 0.0
    return float(np.mean(np.abs(a - b)[either] / np.maximum(a, b)[either]))


def _frozen_poses(usable: Sequence[FrameFacts]) -> list[Finding]:
    """Report poses that repeat, digit by digit, while depth changes."""
    frozen = [
        after.frame_id
        for before, after in pairwise(usable)
        if np.array_equal(before.pose, after.pose)  # type: ignore[arg-type]
        and before.depth_digest != after.depth_digest
        and _depth_change(before, after) > CHANGED_DEPTH
    ]
    moves = sum(not np.array_equal(a.pose, b.pose) for a, b in pairwise(usable))  # type: ignore[arg-type]
    if not frozen or moves == 0:
        return []
    return [
        Finding(
            kind="frozen-poses",
            severity="fault",
            message=f"The pose of the frame before is repeated digit by digit, although what is seen changes, in "
            f"{counted(len(frozen), 'frame')}: {listed(frozen)}.",
            remedy="Leave them out: tracking stood still, or the poses were not written.",
            evidence={"frames": frozen},
        )
    ]
