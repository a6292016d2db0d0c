"""What two kinds of evidence have in common: residuals in units of the expected noise, and their robust cost."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from datagen.dataset_check.correction import Correction

WORST_RELATIVE = 0.1
"""A residual beyond this share of the depth says 'elsewhere', and costs as much as seeing nothing there at all."""

AGREEING = 0.03
"""Depth that is so near, relatively, is the same surface's."""


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """Predicted minus observed depth, (blocks, samples); a block is a frame, or a pair of frames.

    ``normalised`` is in standard deviations of the noise, NaN where the prediction meets no surface; ``limit`` is
    ``WORST_RELATIVE`` of the depth in the same unit; ``metres`` is the residual and ``depth`` what was seen, metres.
    ``known`` (blocks,) tells for which blocks there are poses.
    """

    normalised: NDArray[np.float64]
    limit: NDArray[np.float64]
    metres: NDArray[np.float64]
    depth: NDArray[np.float64]
    known: NDArray[np.bool_]

    def costs(self, sigma_factor: float) -> NDArray[np.float64]:
        """Return the cost of each sample, log(1 + e²) with e capped at the limit; ``sigma_factor`` widens the noise.

        The Cauchy distribution's: from a tenth to a hundredth of the residual is as much a gain as from a hundredth
        to a thousandth, so that one measure serves flipped axes and half pixels.
        """
        limit = self.limit / sigma_factor
        e = np.minimum(np.nan_to_num(np.abs(self.normalised) / sigma_factor, nan=np.inf), limit)
        return np.log1p(e * e)

    @property
    def median_m(self) -> float:
        """Median size of the residuals that meet a surface, metres; NaN where none does."""
        met = np.abs(self.metres[np.isfinite(self.metres)])
        return float(np.median(met)) if met.size else float("nan")

    @property
    def median_sigmas(self) -> float:
        """Median size of the residuals that meet a surface, in standard deviations of the noise; infinite for none."""
        met = np.abs(self.normalised[np.isfinite(self.normalised)])
        return float(np.median(met)) if met.size else float("inf")

    @property
    def agreement(self) -> float:
        """Share of the samples that meet a surface whose depth is within ``AGREEING`` of what was seen."""
        met = np.isfinite(self.metres)
        return float((np.abs(self.metres[met]) < AGREEING * self.depth[met]).mean()) if met.any() else 0.0

    @property
    def overlap(self) -> float:
        """Share of the samples that meet a surface."""
        return float(np.isfinite(self.metres).mean()) if self.metres.size else 0.0


class Evidence(Protocol):
    """Something that a hypothesis can be held against."""

    name: str

    def residuals(self, correction: Correction, *, every: int = 1) -> Residuals:
        """Return the residuals under a correction, of every ``every``-th sample."""


def stacked(parts: list[Residuals]) -> Residuals:
    """Return residuals of several kinds of evidence as one; blocks must have equally many samples."""
    return Residuals(
        normalised=np.concatenate([part.normalised for part in parts]),
        limit=np.concatenate([part.limit for part in parts]),
        metres=np.concatenate([part.metres for part in parts]),
        depth=np.concatenate([part.depth for part in parts]),
        known=np.concatenate([part.known for part in parts]),
    )


def sample_smooth_pixels(
    smooth: NDArray[np.bool_], count: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
    """Return columns and rows (count,) of random smooth pixels of an image (H, W), None where it has too few.

    Drawn without repetition where there are enough.
    """
    candidates = np.flatnonzero(smooth)
    if candidates.size < max(20, count // 10):
        return None
    chosen = rng.choice(candidates, count, replace=candidates.size < count)
    rows, columns = np.divmod(chosen, smooth.shape[1])
    return columns, rows
