"""Errors as colours: a perceptual map and the bar that explains it."""

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray


def heat(values: ArrayLike, *, most: float) -> NDArray[np.float64]:
    """Return sRGB colours (…, 3) from 0 to 1 for values from 0 (dark) to ``most`` and beyond (bright)."""
    steps = np.rint(255 * np.clip(np.asarray(values, dtype=np.float64) / most, 0, 1)).astype(np.uint8)
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8), cv2.COLORMAP_VIRIDIS)[:, 0, ::-1]
    return table[steps] / 255


def heat_bar(*, width: int = 256, height: int = 12) -> NDArray[np.uint8]:
    """Return the bar (height, width, 3) from 0, left, to the most."""
    colors = heat(np.linspace(0, 1, width), most=1.0)
    return np.broadcast_to(np.rint(255 * colors).astype(np.uint8), (height, width, 3)).copy()
