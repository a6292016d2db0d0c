"""What can be wrong with a dataset: hypotheses, each a correction that would make it right."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

from datagen.dataset_check.correction import Correction

FOCAL_FACTORS = (0.7, 0.78, 0.84, 0.89, 0.93, 0.97, 1.03, 1.07, 1.12, 1.19, 1.28, 1.43)
DEPTH_FACTORS = (
    0.001,
    0.01,
    0.1,
    0.2,
    0.5,
    0.75,
    0.82,
    0.88,
    0.94,
    0.98,
    1.02,
    1.06,
    1.13,
    1.2,
    1.33,
    2,
    5,
    10,
    100,
    1000,
)
HALF_PIXELS = tuple((x, y) for x, y in product((-0.5, 0.0, 0.5), repeat=2))
LONGEST_POSE_SHIFT = 10

FITTED = {
    "principal-point": ("cx", "cy"),
    "focal-length": ("log_f",),
    "focal-length-x": ("log_fx",),
    "focal-length-y": ("log_fy",),
    "depth-scale": ("log_depth",),
}
"""Hypotheses with a size: what is fitted."""


@dataclass(frozen=True)
class Hypothesis:
    """A kind of fault, and the correction that would mend it."""

    kind: str
    correction: Correction


def hypotheses(base: Correction, *, frames: int) -> Iterator[Hypothesis]:
    """Yield single further faults on top of ``base``; those with a size come several times, to be fitted from there."""
    yield from _sized(base)
    yield from _structural(base)
    most = min(LONGEST_POSE_SHIFT, frames // 2)
    for shift in (sign * k for k in range(1, most + 1) for sign in (1, -1)):
        if base.pose_shift == 0:
            yield Hypothesis("time-shift", replace(base, pose_shift=shift))


def _sized(base: Correction) -> Iterator[Hypothesis]:
    for x, y in HALF_PIXELS:
        yield Hypothesis("principal-point", base.moved({"cx": x, "cy": y}))
    fx, fy = base.focal_factor
    for factor in FOCAL_FACTORS:
        yield Hypothesis("focal-length", replace(base, focal_factor=(fx * factor, fy * factor)))
        yield Hypothesis("focal-length-x", replace(base, focal_factor=(fx * factor, fy)))
        yield Hypothesis("focal-length-y", replace(base, focal_factor=(fx, fy * factor)))
    for factor in DEPTH_FACTORS:
        yield Hypothesis("depth-scale", replace(base, depth_factor=base.depth_factor * factor))


def _structural(base: Correction) -> Iterator[Hypothesis]:
    if not base.ray_distance:
        yield Hypothesis("ray-distance", replace(base, ray_distance=True))
    if base.pose_form == "stored":
        yield Hypothesis("inverse-pose", replace(base, pose_form="inverse"))
        yield Hypothesis("transposed-rotation", replace(base, pose_form="transposed"))
    if base.axes == (1, 1, 1):
        for x, y, z in product((1, -1), repeat=3):
            axes = (x, y, z)
            if axes != (1, 1, 1):
                yield Hypothesis("flipped-axis", replace(base, axes=axes))
                if z > 0:
                    yield Hypothesis("flipped-axis", replace(base, axes=axes, mirrored_image=True))
        if base.pose_form == "stored":
            for turned in ((1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
                yield Hypothesis("inverse-pose", replace(base, axes=turned, pose_form="inverse"))
