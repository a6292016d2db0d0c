"""The frames that a check looks at: depth, inverse depth, where it is smooth, and the poses of the whole sequence."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.dataset_check.depth_noise import DepthNoise

SMOOTH_RANGE = 0.06
"""Largest relative range of inverse depth in the 3×3 pixels around one that counts as lying on one surface."""


@dataclass(frozen=True, kw_only=True)
class Views:
    """Some images of a sequence, and the poses of all of it.

    ``poses`` (n, 4, 4) are the stored world_from_camera of the whole sequence; ``positions`` (m,) tell which of them
    the images belong to. ``depth`` (m, H, W) metres as stored, 0 invalid; ``smooth`` marks pixels within one surface.
    """

    camera: PinholeCamera
    poses: NDArray[np.float64]
    positions: NDArray[np.int64]
    depth: NDArray[np.float32]
    smooth: NDArray[np.bool_]
    noise: DepthNoise

    @property
    def median_depth(self) -> float:
        """Median of the valid stored depth, metres."""
        return float(np.median(self.depth[self.depth > 0]))


def smooth_pixels(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return where the 3×3 neighbourhood of a pixel is valid and within one surface (H, W); never the border."""
    nearness = inverse_depth(depth)
    kernel = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(nearness, kernel), cv2.dilate(nearness, kernel)
    smooth = (low > 0) & (high - low < SMOOTH_RANGE * nearness)
    smooth[[0, -1], :] = False
    smooth[:, [0, -1]] = False
    return smooth


def inverse_depth(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return 1/depth, 0 where invalid: planes are linear in it, so that it is what may be interpolated."""
    return np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
