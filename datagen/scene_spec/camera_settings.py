"""The lens and the sensor."""

from typing import Self

from pydantic import Field, model_validator

from datagen.scene_spec.base import Spec


class CameraSettings(Spec):
    """The lens: focal length and the width of the sensor it projects on; surfaces outside the clip range are not seen.

    The sensor's width spans the image's width, whichever side of the image is longer.
    """

    focal_length_mm: float = Field(default=50.0, ge=1, le=5000)
    sensor_width_mm: float = Field(default=36.0, ge=1, le=1000)
    clip_start: float = Field(default=0.01, ge=1e-4)
    clip_end: float = Field(default=100.0, le=1e6)

    @model_validator(mode="after")
    def _clip_range_is_not_empty(self) -> Self:
        if self.clip_end <= self.clip_start:
            raise ValueError(f"clip_end {self.clip_end} must be greater than clip_start {self.clip_start}")
        return self
