"""The box of the world in which the object is, where a dataset shows more than that."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import Matrix, transform_points

Corner = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class ObjectBox:
    """A box along the world's axes, from ``low`` to ``high``, metres. Raises InputError for one that holds nothing."""

    low: Corner
    high: Corner

    def __post_init__(self) -> None:
        """Refuse bounds that are none."""
        corners = np.array([self.low, self.high], dtype=np.float64)
        if not np.isfinite(corners).all() or not (corners[0] < corners[1]).all():
            low, high = (" ".join(f"{value:g}" for value in corner) for corner in corners)
            raise InputError(f"--box {low} {high}: expected the box's low corner and then its high one, metres")

    def holds(self, points_world: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Tell which points (…, 3) lie in the box."""
        return np.asarray(((points_world >= self.low) & (points_world <= self.high)).all(axis=-1))

    def mask(self, depth: NDArray[np.float32], camera: PinholeCamera, world_from_camera: Matrix) -> NDArray[np.bool_]:
        """Return where (height, width) a frame's planar depth, metres, shows what lies in the box."""
        return np.asarray((depth > 0) & self.holds(transform_points(world_from_camera, camera.back_project(depth))))
