"""The pinhole camera: OpenCV axes, integer pixel centres, planar depth."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.errors import InputError

LARGEST_FOCAL_RATIO = 1000.0
"""Between a focal length and the image's longer side; beyond it, no lens is meant."""


@dataclass(frozen=True, kw_only=True)
class PinholeCamera:
    """Intrinsics of an ideal camera, in pixels.

    Axes are x right, y down, z forward. Integer coordinates are pixel centres: u = fx·x/z + cx, and the image spans
    [-0.5, width − 0.5] × [-0.5, height − 0.5]. Raises InputError for a size or focal length that no camera has.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        """Refuse intrinsics that no camera has."""
        if self.width < 1 or self.height < 1:
            raise InputError(f"camera: image size {self.width}×{self.height}, expected at least 1×1")
        side = max(self.width, self.height)
        least, most = side / LARGEST_FOCAL_RATIO, side * LARGEST_FOCAL_RATIO
        for name, focal in (("fx", self.fx), ("fy", self.fy)):
            if not least <= focal <= most:
                raise InputError(
                    f"camera: {name} {focal:g} for an image of {self.width}×{self.height} pixels, expected {least:g}"
                    f" to {most:g}; focal lengths are in pixels"
                )
        if not np.isfinite([self.cx, self.cy]).all():
            raise InputError(f"camera: cx {self.cx}, cy {self.cy}; expected finite numbers")

    @classmethod
    def from_corner_origin(
        cls, *, width: int, height: int, fx: float, fy: float, cx: float, cy: float
    ) -> "PinholeCamera":
        """Make a camera from a principal point measured from the image's corner, where pixel centres lie at +0.5.

        Blender, COLMAP and instant-ngp measure so; this is the one place where the half pixel is taken off.
        """
        return cls(width=width, height=height, fx=fx, fy=fy, cx=cx - 0.5, cy=cy - 0.5)

    @property
    def corner_origin(self) -> tuple[float, float]:
        """The principal point (cx, cy) measured from the image's corner; the inverse of ``from_corner_origin``."""
        return self.cx + 0.5, self.cy + 0.5

    def subsampled(self, step: int) -> "PinholeCamera":
        """Return the camera of ``image[::step, ::step]``."""
        return PinholeCamera(
            width=-(-self.width // step),
            height=-(-self.height // step),
            fx=self.fx / step,
            fy=self.fy / step,
            cx=self.cx / step,
            cy=self.cy / step,
        )

    def project(self, points_camera: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return pixel coordinates (…, 2) of points (…, 3) in the camera frame; meaningful where z > 0."""
        x, y, z = np.moveaxis(np.asarray(points_camera, dtype=np.float64), -1, 0)
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=-1)

    def back_project(self, depth: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the points (height, width, 3) in the camera frame, metres, of a planar depth image (height, width).

        Where depth is 0 (invalid) the point is the origin.
        """
        z = np.asarray(depth, dtype=np.float64)
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return np.stack([(u - self.cx) / self.fx * z, (v - self.cy) / self.fy * z, z], axis=-1)
