"""What a pattern paints, and how colours are mixed for it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Field = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Picture:
    """``color`` (H, W, 3) sRGB from 0 to 1, first row on top; ``dullness`` (H, W) from −1, glossier, to 1, duller."""

    color: Field
    dullness: Field


def mix(first: ArrayLike, second: ArrayLike, share: Field) -> Field:
    """Return colours (H, W, 3) that go from ``first`` to ``second`` (3 numbers, or (H, W, 3)) by ``share`` (H, W)."""
    weight = np.clip(share, 0, 1)[..., None].astype(np.float32)
    return (np.asarray(first, np.float32) * (1 - weight) + np.asarray(second, np.float32) * weight).astype(np.float32)


def shade(color: Field, factor: Field) -> Field:
    """Return ``color`` (H, W, 3) made lighter or darker by ``factor`` (H, W), kept within 0 to 1."""
    return np.clip(color * factor[..., None], 0, 1).astype(np.float32)


def average(colors: Sequence[Sequence[float]]) -> NDArray[np.float32]:
    """Return the mean of some colours."""
    return np.mean(np.asarray(colors, np.float32), axis=0)


def smoothstep(low: float, high: float, value: ArrayLike) -> Field:
    """Return 0 below ``low``, 1 above ``high``, and a smooth rise between."""
    share = np.clip((np.asarray(value, np.float32) - low) / (high - low), 0, 1)
    return (share * share * (3 - 2 * share)).astype(np.float32)
