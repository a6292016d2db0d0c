"""The sRGB transfer function (IEC 61966-2-1)."""

import functools

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
    """Return 8-bit sRGB for linear light, any shape, rounded to the nearest step.

    The step is found from the number's leading bits and one comparison, ten times as fast as the formula; single
    precision decides between two steps.
    """
    table, rises = _step_tables()
    value = np.asarray(linear, dtype=np.float32)
    value = np.fmin(np.fmax(value, _DARKEST), np.float32(1))  # fmax makes black of what is no number
    bins = (value.view(np.uint32) - _DARKEST.view(np.uint32)) >> np.uint32(_BITS_LEFT_OUT)
    step = table[bins]
    return step + (value >= rises[step])


_DARKEST = np.float32(2.0**-13)
"""Below the first step's rise, 0.5/255/12.92."""
_BITS_LEFT_OUT = 15
"""Of 23: so that a bin is 0.4 % wide at most, less than two steps are apart."""


@functools.cache
def _step_tables() -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return for each bin of leading bits the sRGB step at its begin, and for each step the light that ends it."""
    rises = linear_from_srgb((np.arange(255) + 0.5) / 255).astype(np.float32)
    first, last = _DARKEST.view(np.uint32), np.float32(1).view(np.uint32)
    bits = first + (np.arange(((last - first) >> _BITS_LEFT_OUT) + 1, dtype=np.uint32) << _BITS_LEFT_OUT)
    table = np.searchsorted(rises, bits.astype(np.uint32).view(np.float32), side="right").astype(np.uint8)
    return table, np.append(rises, np.float32(np.inf))
