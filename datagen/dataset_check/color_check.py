"""Is colour where depth is?"""

import numpy as np

from datagen.dataset import Dataset
from datagen.dataset_check.color_alignment import ColorAlignment, measure_color_alignment
from datagen.dataset_check.findings import CANNOT_TELL, Finding
from datagen.dataset_check.frame_facts import FrameFacts
from datagen.errors import InputError
from datagen.formats.seven_scenes import FORMAT as SEVEN_SCENES

FRAMES = 24
LEAST_OFFSET_PX = 1.0
LEAST_SIGNIFICANCE = 4.0

UNREGISTERED_FORMATS = (SEVEN_SCENES.title,)
"""Formats whose recordings are known to come without registration: an offset there is worth knowing, but no fault."""


def check_color(dataset: Dataset, facts: list[FrameFacts], rng: np.random.Generator) -> list[Finding]:
    """Report how far colour lies beside depth, from edges of depth in some ``FRAMES`` frames."""
    usable = [each for each in facts if each.color_digest is not None and each.valid_share > 0]
    chosen = np.unique(np.linspace(0, len(usable) - 1, min(FRAMES, len(usable))).round().astype(int)) if usable else []
    images = []
    for i in chosen:
        try:
            images.append((dataset.color(usable[i].frame_id), dataset.depth(usable[i].frame_id)))
        except InputError:  # damaged since it was first read; the file check reports what it saw then
            continue
    alignment = measure_color_alignment(images, rng)
    if alignment is None or not alignment.is_clear:
        return [_cannot_tell(alignment)]
    if alignment.zoom == 1 and (alignment.length_px < LEAST_OFFSET_PX or alignment.significance < LEAST_SIGNIFICANCE):
        return []
    return [_offset(alignment, dataset)]


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
        remedy="Register colour to depth with both cameras' calibration; or shift the colour images back, where the "
        "offset is the same at all depths."
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
    return Finding(
        kind=CANNOT_TELL,
        severity="note",
        message=f"Whether colour lies where depth does cannot be told: {reason}.",
        remedy="Frames in which one thing stands before another would tell.",
        evidence={"kinds": ["color-offset"]},
    )
