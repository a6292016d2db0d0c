"""Depth in colours: a scale in metres that holds for all frames of a dataset."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.errors import InputError

INVALID_COLOR = (232, 234, 238)
"""Pale grey: no colour of the map comes near it."""
OUTLIERS_PERCENT = 0.5
MOST_TICKS = 7


@dataclass(frozen=True, kw_only=True)
class DepthScale:
    """The depths, in metres, that the two ends of the colour map stand for; beyond them colours stay the same."""

    nearest: float
    farthest: float

    @property
    def ticks(self) -> tuple[float, ...]:
        """Round depths within the scale, at most ``MOST_TICKS``."""
        rough = (self.farthest - self.nearest) / (MOST_TICKS - 1)
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough * (1 - 1e-9))
        first, last = math.ceil(self.nearest / step - 1e-6), math.floor(self.farthest / step + 1e-6)
        return tuple(i * step for i in range(first, last + 1))

    def label(self, depth: float) -> str:
        """Return ``depth`` in metres with the digits that tell ticks apart."""
        ticks = self.ticks
        step = ticks[1] - ticks[0] if len(ticks) > 1 else self.farthest - self.nearest
        return f"{depth:.{max(0, -math.floor(math.log10(step) + 1e-9))}f}"


def depth_scale(images: list[NDArray[np.float32]], *, source: str) -> DepthScale:
    """Return the scale that spans the valid depths (metres) of ``images`` but for half a percent at either end.

    Raises InputError, beginning with ``source``, where no pixel is valid.
    """
    valid = np.concatenate([image[image > 0] for image in images]) if images else np.empty(0, np.float32)
    if valid.size == 0:
        raise InputError(f"{source}: {len(images)} depth images were read and none has a valid pixel")
    nearest, farthest = np.percentile(valid, [OUTLIERS_PERCENT, 100 - OUTLIERS_PERCENT])
    if farthest - nearest < 1e-3 * farthest:  # a wall seen straight on
        nearest, farthest = 0.95 * nearest, 1.05 * farthest
    return DepthScale(nearest=float(nearest), farthest=float(farthest))


def colored_depth(depth: NDArray[np.float32], scale: DepthScale) -> NDArray[np.uint8]:
    """Return depth (H, W) in metres as RGB (H, W, 3): viridis, near bright, far dark; pale grey where invalid."""
    share = (depth - np.float32(scale.nearest)) / np.float32(scale.farthest - scale.nearest)
    colors = _viridis(1 - np.clip(share, 0, 1))
    colors[depth <= 0] = INVALID_COLOR
    return colors


def scale_strip(length: int, breadth: int) -> NDArray[np.uint8]:
    """Return the colour map (breadth, length, 3) from the nearest depth to the farthest, left to right."""
    along = np.linspace(1, 0, length, dtype=np.float32)
    return np.repeat(_viridis(along[None, :]), breadth, axis=0)


def _viridis(value: NDArray) -> NDArray[np.uint8]:
    colors = cv2.applyColorMap(np.rint(value * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    return cv2.cvtColor(colors, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
