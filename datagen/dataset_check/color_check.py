"""Is colour where depth is?"""

import numpy as np

from datagen.dataset import Dataset
from datagen.dataset_check.color_alignment import ColorAlignment, measure_color_alignment
from datagen.dataset_check.findings import CANNOT_TELL, Finding
from datagen.dataset_check.frame_facts import FrameFacts, typical_depth
from datagen.dataset_check.pair_selection import choose_pairs
from datagen.dataset_check.photo_consistency import PhotoConsistency, View, measure_photo_consistency
from datagen.errors import InputError
from datagen.formats.seven_scenes import FORMAT as SEVEN_SCENES

FRAMES = 24
ANCHORS = 40
LEAST_OFFSET_PX = 1.0
LEAST_SIGNIFICANCE = 4.0

SHIFT_BACK = (
    "Register colour to depth with both cameras' calibration; or shift the colour images back, where the offset is the "
    "same at all depths."
)

UNREGISTERED_FORMATS = (SEVEN_SCENES.title,)
"""Formats whose recordings are known to come without registration: an offset there is worth knowing, but no fault."""


def check_color(
    dataset: Dataset, facts: list[FrameFacts], rng: np.random.Generator, *, geometry_holds: bool
) -> list[Finding]:
    """Report how far colour lies beside depth, from edges of depth in some ``FRAMES`` frames.

    Where depth's edges do not tell, and poses and intrinsics are right (``geometry_holds``), images are compared.
    """
    usable = [each for each in facts if each.color_digest is not None and each.valid_share > 0]
    chosen = np.unique(np.linspace(0, len(usable) - 1, min(FRAMES, len(usable))).round().astype(int)) if usable else []
    images = []
    for i in chosen:
        try:
            images.append((dataset.color(usable[i].frame_id), dataset.depth(usable[i].frame_id)))
        except InputError:  # damaged since it was first read; the file check reports what it saw then
            continue
    alignment = measure_color_alignment(images, rng)
    if alignment is None or not _tells(alignment):
        consistency = _photo_consistency(dataset, usable, rng) if geometry_holds else None
        if consistency is None or not consistency.is_clear:
            return [_cannot_tell(alignment)]
        return [_inconsistent(consistency)] if consistency.length_px >= LEAST_OFFSET_PX else []
    if alignment.zoom == 1 and alignment.length_px < LEAST_OFFSET_PX:
        return []
    return [_offset(alignment, dataset)]


def _tells(alignment: ColorAlignment) -> bool:
    """Whether the offset is clear, and where it is one, no chance of a few frames."""
    is_none = alignment.zoom == 1 and alignment.length_px < LEAST_OFFSET_PX
    return alignment.is_clear and (is_none or alignment.zoom != 1 or alignment.significance >= LEAST_SIGNIFICANCE)


def _photo_consistency(dataset: Dataset, usable: list[FrameFacts], rng: np.random.Generator) -> PhotoConsistency | None:
    posed = [each for each in usable if each.pose is not None]
    if not posed:
        return None
    poses = np.array([each.pose for each in posed])
    pairs = choose_pairs(poses, anchors=ANCHORS, depth=typical_depth(posed))
    try:
        views = {
            int(i): View(
                color=dataset.color(posed[i].frame_id),
                depth=dataset.depth(posed[i].frame_id),
                world_from_camera=poses[i],
            )
            for i in np.unique(pairs)
        }
    except InputError:  # damaged since it was first read; the file check reports what it saw then
        return None
    return measure_photo_consistency([(views[a], views[b]) for a, b in pairs.tolist()], dataset.camera, rng)


def _inconsistent(consistency: PhotoConsistency) -> Finding:
    x, y = consistency.offset_px
    return Finding(
        kind="color-offset",
        severity="fault",
        message=f"Colour lies beside depth by about ({x:+.0f}, {y:+.0f}) px: there the same points have the same "
        f"colour, as {consistency.pairs} pairs of images tell.",
        remedy=SHIFT_BACK,
        evidence={"offset_px": [x, y], "significance": consistency.significance, "pairs": consistency.pairs},
    )


def _offset(alignment: ColorAlignment, dataset: Dataset) -> Finding:
    x, y = alignment.offset_px
    known = dataset.format_name in UNREGISTERED_FORMATS
    how = f"by ({x:+.1f}, {y:+.1f}) px"
    if alignment.zoom != 1:
        corner = abs(alignment.zoom - 1) * np.hypot(dataset.camera.width, dataset.camera.height) / 2
        how += (
            f" in the image's middle, and scaled by {alignment.zoom:.2f} about it ({corner:.0f} px in the corners): "
            "another lens took it"
        )
    message = (
        f"Colour lies beside depth {how}. {alignment.edges} edges of depth in {alignment.frames} frames are found "
        f"again in colour there ({alignment.significance:.0f} standard errors better than at no offset)."
    )
    if known:
        message += f" {dataset.format_name} recordings are not registered: this is as expected."
    return Finding(
        kind="color-offset",
        severity="note" if known else "fault",
        message=message,
        remedy=SHIFT_BACK
        if alignment.zoom == 1
        else "Register colour to depth with both cameras' calibration; until then, colours near edges are the "
        "background's.",
        evidence={
            "offset_px": [x, y],
            "zoom": alignment.zoom,
            "significance": alignment.significance,
            "prominence": alignment.prominence,
            "edges": alignment.edges,
            "frames": alignment.frames,
        },
    )


def _cannot_tell(alignment: ColorAlignment | None) -> Finding:
    reason = "depth has too few edges" if alignment is None else "depth's edges do not show in colour at any one offset"
    reason += ", nor do images that see the same points tell"
    return Finding(
        kind=CANNOT_TELL,
        severity="note",
        message=f"Whether colour lies where depth does cannot be told: {reason}.",
        remedy="Frames in which one thing stands before another would tell.",
        evidence={"kinds": ["color-offset"]},
    )
