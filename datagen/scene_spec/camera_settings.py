"""The lens and the sensor."""

import math
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from datagen.camera import PinholeCamera
from datagen.scene_spec.base import Positive, Spec

DEFAULT_FOCAL_LENGTH_MM = 50.0
WAYS_TO_SAY_THE_FOCAL_LENGTH = ("focal_length_mm", "field_of_view_deg", "intrinsics_px")


class CameraSettings(Spec):
    """The lens; surfaces outside the clip range are not seen.

    How wide it sees is said in one of three ways: ``focal_length_mm`` (50) with the side of the sensor that it
    projects on, ``field_of_view_deg`` across the fitted side, or ``intrinsics_px``: fx, fy, cx, cy with integer pixel
    centres. The sensor's width (36 mm) spans the image's width with the ``sensor_fit`` horizontal and the longer side
    with auto; its height (24 mm) spans the image's height with vertical. ``shift_x`` and ``shift_y`` move the sensor
    right and up by that share of the fitted side, and ``pixel_aspect`` is a pixel's width over its height, all three
    as Blender has them. ``stereo_baseline`` puts a second camera so many metres to the right.
    """

    focal_length_mm: Annotated[float, Field(ge=1, le=5000)] | None = None
    field_of_view_deg: Annotated[float, Field(ge=0.1, le=179)] | None = None
    intrinsics_px: Annotated[tuple[Positive, Positive, float, float], Field(strict=False)] | None = None
    sensor_width_mm: float = Field(default=36.0, ge=1, le=1000)
    sensor_height_mm: float = Field(default=24.0, ge=1, le=1000)
    sensor_fit: Literal["horizontal", "vertical", "auto"] = "horizontal"
    shift_x: float = Field(default=0.0, ge=-10, le=10)
    shift_y: float = Field(default=0.0, ge=-10, le=10)
    pixel_aspect: float = Field(default=1.0, ge=0.01, le=100)
    stereo_baseline: Positive | None = None
    clip_start: float = Field(default=0.01, ge=1e-4)
    clip_end: float = Field(default=100.0, le=1e6)

    def pinhole(self, size: tuple[int, int]) -> PinholeCamera:
        """Return the intrinsics for images of ``size`` (width, height): Blender's lens law, in double precision.

        Raises InputError for a focal length that no camera has at this size.
        """
        width, height = size
        if self.intrinsics_px is not None:
            fx, fy, cx, cy = self.intrinsics_px
            return PinholeCamera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
        across = self.sensor_fit == "horizontal" or (self.sensor_fit == "auto" and width * self.pixel_aspect >= height)
        # The fitted side, and all along x, in widths of a pixel; a pixel is 1 / pixel_aspect of that high.
        fitted_side = width if across else height / self.pixel_aspect
        fx = self._focal_length_over_sensor() * fitted_side
        return PinholeCamera.from_corner_origin(
            width=width,
            height=height,
            fx=fx,
            fy=fx * self.pixel_aspect,
            cx=width / 2 - self.shift_x * fitted_side,
            cy=height / 2 + self.shift_y * fitted_side * self.pixel_aspect,
        )

    def _focal_length_over_sensor(self) -> float:
        if self.field_of_view_deg is not None:
            return 0.5 / math.tan(math.radians(self.field_of_view_deg) / 2)
        assert self.focal_length_mm is not None
        return self.focal_length_mm / (self.sensor_height_mm if self.sensor_fit == "vertical" else self.sensor_width_mm)

    @model_validator(mode="before")
    @classmethod
    def _has_a_focal_length(cls, content: Any) -> Any:
        if isinstance(content, dict) and all(content.get(key) is None for key in WAYS_TO_SAY_THE_FOCAL_LENGTH):
            return content | {"focal_length_mm": DEFAULT_FOCAL_LENGTH_MM}
        return content

    @model_validator(mode="after")
    def _says_each_thing_once(self) -> Self:
        given = [key for key in WAYS_TO_SAY_THE_FOCAL_LENGTH if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(f"give one of {', '.join(WAYS_TO_SAY_THE_FOCAL_LENGTH)}, not {' and '.join(given)}")
        if self.intrinsics_px is not None and (self.shift_x, self.shift_y, self.pixel_aspect) != (0, 0, 1):
            raise ValueError("intrinsics_px say all: leave shift_x, shift_y and pixel_aspect out")
        return self

    @model_validator(mode="after")
    def _clip_range_is_not_empty(self) -> Self:
        if self.clip_end <= self.clip_start:
            raise ValueError(f"clip_end {self.clip_end} must be greater than clip_start {self.clip_start}")
        return self
