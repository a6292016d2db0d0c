"""Which hypothesis explains the residuals: fitting each, comparing them, and how sure that is."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from datagen.dataset_check.correction import Correction
from datagen.dataset_check.fitting import Judge, mean_cost
from datagen.dataset_check.hypotheses import FITTED, Hypothesis, hypotheses
from datagen.dataset_check.residuals import Residuals

COARSE, FINE = 8, 4
"""The first look takes every eighth sample, the first fit every fourth."""

FINALISTS, FINAL_ITERATIONS = 3, 3
WITHIN_REACH = 3.0
"""A hypothesis that is so much worse than the best, before its size is fitted, need not be."""

LEAST_GAIN = 0.25
"""A fault must lower the mean cost by this much: about what halving every residual does (log 4 would be all of it)."""

NOTABLE_GAIN = 0.03
LEAST_SIGNIFICANCE = 5.0
"""Standard errors, between blocks, by which a gain must be above nothing."""

TIE = 0.02
TIE_SIGNIFICANCE = 3.0

LEAST_SIZE = {"principal-point": 0.25, "focal-length": 0.008, "depth-scale": 0.004}
"""Smaller departures are calibration, not faults: pixels, and logarithms of factors."""


@dataclass(frozen=True, kw_only=True)
class Judged:
    """A hypothesis with its residuals at hand, and its mean cost under the noise that the best hypothesis leaves."""

    kind: str
    correction: Correction
    residuals: Residuals
    cost: float


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The outcome of one round: ``best`` against ``base``, and the others that explain as much."""

    base: Judged
    best: Judged
    rivals: tuple[Judged, ...]
    gain: float
    significance: float
    sigma_factor: float

    @property
    def is_fault(self) -> bool:
        """Whether the best hypothesis is a fault, by the size of its gain, its significance and its own size."""
        return self.gain >= LEAST_GAIN and self._is_sure

    @property
    def is_notable(self) -> bool:
        """Whether the best hypothesis explains a little, surely."""
        return self.gain >= NOTABLE_GAIN and self._is_sure

    @property
    def _is_sure(self) -> bool:
        sizeable = _is_sizeable(self.best.kind, self.base.correction, self.best.correction)
        return self.best is not self.base and sizeable and self.significance >= LEAST_SIGNIFICANCE


def compare(judge: Judge, base: Correction, *, frames: int) -> Verdict:
    """Hold all single faults on top of ``base`` against the evidence; the best is ``base`` where none is better."""
    coarse: dict[tuple[str, int], tuple[float, Hypothesis]] = {}
    for hypothesis in hypotheses(base, frames=frames):
        cost = judge.cost(hypothesis.correction, every=COARSE)
        key = hypothesis.kind, hypothesis.correction.pose_shift
        if cost < coarse.get(key, (np.inf,))[0]:
            coarse[key] = cost, hypothesis
    polished = []
    least = min(cost for cost, _ in coarse.values())
    for (kind, _), (cost, hypothesis) in coarse.items():
        correction = hypothesis.correction
        if kind in FITTED and cost < least + WITHIN_REACH:
            correction = judge.fit(correction, FITTED[kind], every=FINE)
            cost = judge.cost(correction, every=COARSE)  # noqa: PLW2901
        polished.append((cost, kind, correction))
    polished.sort(key=lambda entry: entry[0])
    finalists = polished[:FINALISTS]
    kinds = {kind for _, kind, _ in finalists}
    # Of one kind there are several shifts of the poses: they leave room for others.
    finalists += [entry for entry in polished if entry[1] not in kinds][: FINALISTS - len(kinds)]
    return _verdict(_judged(judge, "none", base), [_judged(judge, kind, each) for _, kind, each in finalists])


def _judged(judge: Judge, kind: str, correction: Correction) -> Judged:
    if kind in FITTED:
        correction = judge.fit(correction, FITTED[kind], iterations=FINAL_ITERATIONS)
    residuals = judge.residuals(correction)
    return Judged(kind=kind, correction=correction, residuals=residuals, cost=mean_cost(residuals))


def _verdict(base: Judged, candidates: list[Judged]) -> Verdict:
    """Compare under the noise that the best leaves: what no hypothesis explains makes all of them alike."""
    factor = spread(min([base, *candidates], key=lambda judged: judged.cost).residuals)
    base, *candidates = (replace(each, cost=mean_cost(each.residuals, factor)) for each in [base, *candidates])
    best = base
    for each in sorted(candidates, key=lambda judged: judged.cost):
        if advantage(each, best, factor)[0] > 0:  # in the blocks that both have poses for
            best = each
    gain, significance = advantage(best, base, factor)
    rivals = []
    for each in candidates:
        lead, sure = advantage(best, each, factor)
        sizeable = _is_sizeable(each.kind, base.correction, each.correction)
        if each is not best and sizeable and (lead < TIE or sure < TIE_SIGNIFICANCE):
            rivals.append(each)
    return Verdict(
        base=base, best=best, rivals=tuple(rivals), gain=gain, significance=significance, sigma_factor=factor
    )


def spread(residuals: Residuals) -> float:
    """Return how much wider than the measured noise the residuals are, robustly; at least 1."""
    e = np.abs(residuals.normalised)
    inliers = e[(e < residuals.limit) & residuals.known[:, None]]
    return max(1.0, 1.4826 * float(np.median(inliers))) if inliers.size else 1.0


def advantage(ours: Judged, other: Judged, sigma_factor: float) -> tuple[float, float]:
    """Return how much lower our mean cost is, and that in standard errors over the blocks.

    Over the samples that meet a surface under both where most do: then what leaves the image does not count.
    """
    known = ours.residuals.known & other.residuals.known
    if known.sum() < 2:
        return 0.0, 0.0
    costs = other.residuals.costs(sigma_factor)[known] - ours.residuals.costs(sigma_factor)[known]
    both = np.isfinite(ours.residuals.normalised[known]) & np.isfinite(other.residuals.normalised[known])
    met = np.isfinite(ours.residuals.normalised[known]).sum() + np.isfinite(other.residuals.normalised[known]).sum()
    if 2 * both.sum() > 0.8 * met:
        counts = both.sum(axis=1)
        costs = np.where(both, costs, 0)[counts > 0].sum(axis=1) / counts[counts > 0]
        return _mean_and_significance(costs)
    return _mean_and_significance(costs.mean(axis=1))


def _mean_and_significance(values: NDArray[np.float64]) -> tuple[float, float]:
    if len(values) < 2:
        return 0.0, 0.0
    error = float(values.std(ddof=1)) / np.sqrt(len(values))
    mean = float(values.mean())
    return mean, mean / max(error, 1e-9)


def _is_sizeable(kind: str, base: Correction, correction: Correction) -> bool:
    focal = np.log(np.divide(correction.focal_factor, base.focal_factor))
    shift = np.subtract(correction.principal_shift_px, base.principal_shift_px)
    depth = np.log(correction.depth_factor / base.depth_factor)
    sizes = {"principal-point": np.abs(shift).max(), "focal-length": np.abs(focal).max(), "depth-scale": abs(depth)}
    name = "focal-length" if kind.startswith("focal-length") else kind
    return name not in sizes or bool(sizes[name] >= LEAST_SIZE[name])
