"""The sRGB transfer function (IEC 61966-2-1)."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def linear_from_srgb(srgb: ArrayLike) -> NDArray[np.float64]:
    """Return linear light for sRGB values in [0, 1], any shape."""
    value = np.asarray(srgb, dtype=np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: ArrayLike) -> NDArray[np.float64]:
    """Return sRGB values in [0, 1] for linear light, any shape; light beyond black and white clips."""
    value = np.clip(np.asarray(linear, dtype=np.float64), 0, 1)
    return np.where(value <= 0.0031308, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055)


def srgb8_from_linear(linear: ArrayLike) -> NDArray[np.uint8]:
    """Return 8-bit sRGB for linear light, any shape, rounded to the nearest step."""
    return np.rint(srgb_from_linear(linear) * 255).astype(np.uint8)
