"""The options of a reconstruction, and what the data suggest where an option is left open."""

import math
from dataclasses import dataclass

from datagen.errors import InputError
from fusion.survey import SceneSurvey

VOXELS_PER_TRUNCATION = 4
FOOTPRINTS_PER_VOXEL = 2
VOXELS_PER_EXTENT = 512


@dataclass(frozen=True, kw_only=True)
class ReconstructionConfig:
    """What ``fusion reconstruct`` was asked for; None leaves a length to the data.

    ``voxel_size``, ``truncation`` and ``depth_max`` are metres; ``frames`` is START:STOP:STEP; ``device`` auto, cpu or
    cuda[:N]. Raises InputError for a length that is not positive and finite, or a truncation of less than a voxel.
    """

    voxel_size: float | None = None
    truncation: float | None = None
    depth_max: float | None = None
    frames: str | None = None
    device: str = "auto"

    def __post_init__(self) -> None:
        """Refuse lengths that make no volume."""
        for name in ("voxel_size", "truncation", "depth_max"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InputError(f"--{name.replace('_', '-')} {value:g}: expected a positive number of metres")
        if self.voxel_size and self.truncation and self.truncation < self.voxel_size:
            raise InputError(
                f"--truncation {self.truncation:g}: less than a voxel ({self.voxel_size:g} m) leaves holes; "
                f"use {VOXELS_PER_TRUNCATION * self.voxel_size:g}"
            )


def choose_voxel_size(survey: SceneSurvey) -> float:
    """Return a voxel size in metres, two digits, that suits the data.

    Twice a pixel's footprint, below which a voxel sees noise of single pixels; but no less than a 512th of the extent,
    so that a large scene stays affordable.
    """
    size = max(FOOTPRINTS_PER_VOXEL * survey.pixel_footprint, survey.typical_extent / VOXELS_PER_EXTENT)
    return float(f"{size:.2g}")
