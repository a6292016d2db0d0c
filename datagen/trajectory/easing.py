"""Easing equations: how far a motion has come (0 to 1, some beyond) when a part of its time has passed.

Robert Penner, Programming Macromedia Flash MX (2002), chapter 7, in the variants that Blender evaluates.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

OVERSHOOT = 1.70158
"""Of "back": a tenth of the way."""
IN_OUT_STRETCH = 1.525
"""Of the overshoot where "back" eases both in and out."""
ELASTIC_PERIOD, ELASTIC_PERIOD_IN_OUT = 0.3, 0.45
"""Of the time that easing in takes: all of it between the keys, or half of it where it is in and out."""
POWERS = {"quad": 2, "cubic": 3, "quart": 4, "quint": 5}
EASE_OUT_BY_ITSELF = ("back", "bounce", "elastic")
EASINGS = ("sine", *POWERS, "expo", "circ", *EASE_OUT_BY_ITSELF)


def ease(name: str, easing: str, time: Array) -> Array:
    """Return the progress (N,) at ``time`` (N,), both as parts of the way between two keys.

    ``name`` is one of ``EASINGS``; ``easing`` "in" starts slowly, "out" ends slowly, "in-out" both, and "auto" is
    "out" for those that overshoot and "in" for the others.
    """
    if easing == "auto":
        easing = "out" if name in EASE_OUT_BY_ITSELF else "in"
    ease_in = _ease_in(name, both_sides=easing == "in-out")
    if easing == "in":
        return ease_in(time)
    if easing == "out":
        return 1 - ease_in(1 - time)
    first_half = time < 0.5
    progress = ease_in(np.where(first_half, 2 * time, 2 - 2 * time)) / 2
    return np.where(first_half, progress, 1 - progress)


def _ease_in(name: str, *, both_sides: bool) -> Callable[[Array], Array]:
    if name == "sine":
        return lambda t: 1 - np.cos(t * np.pi / 2)
    if name in POWERS:
        return lambda t: t ** POWERS[name]
    if name == "expo":
        # Moved and scaled so that it is 0 at 0.
        return lambda t: (2 ** (10 * (t - 1)) - 2**-10) / (1 - 2**-10)
    if name == "circ":
        return lambda t: 1 - np.sqrt(np.maximum(1 - t * t, 0))
    if name == "back":
        overshoot = OVERSHOOT * (IN_OUT_STRETCH if both_sides else 1)
        return lambda t: t * t * ((overshoot + 1) * t - overshoot)
    if name == "bounce":
        return lambda t: 1 - _bounce_out(1 - t)
    period = ELASTIC_PERIOD_IN_OUT if both_sides else ELASTIC_PERIOD
    return lambda t: _elastic_in(t, period)


def _bounce_out(time: Array) -> Array:
    """Return four parabolas that touch 1 between them."""
    centres = np.array([0, 1.5, 2.25, 2.625]) / 2.75
    heights = np.array([0, 0.75, 0.9375, 0.984375])
    which = np.searchsorted(np.array([1, 2, 2.5]) / 2.75, time, side="right")
    return 7.5625 * (time - centres[which]) ** 2 + heights[which]


def _elastic_in(time: Array, period: float) -> Array:
    swing = 2 ** (10 * (time - 1)) * np.cos((time - 1) * 2 * np.pi / period)
    return np.where(time <= 0, 0.0, swing)
