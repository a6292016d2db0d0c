"""Fitting the continuous parameters of a correction: robust Gauss-Newton with numeric derivatives."""

import numpy as np

from datagen.dataset_check.correction import PARAMETERS, Correction
from datagen.dataset_check.residuals import Evidence, Residuals, stacked

ITERATIONS = 10
LEAST_SAMPLES = 50
CONVERGED = 0.05
"""A step of so small a share of the steps for the derivatives ends the fit."""


class Judge:
    """Holds corrections against all evidence there is: costs, and fits of continuous parameters."""

    def __init__(self, evidence: list[Evidence]) -> None:
        self.evidence = evidence

    def residuals(self, correction: Correction, *, every: int = 1) -> Residuals:
        """Return the residuals of all evidence, stacked."""
        return stacked([each.residuals(correction, every=every) for each in self.evidence])

    def cost(self, correction: Correction, *, sigma_factor: float = 1.0, every: int = 1) -> float:
        """Return the mean cost of a sample, infinite where no block has poses."""
        return mean_cost(self.residuals(correction, every=every), sigma_factor)

    def fit(
        self, start: Correction, names: tuple[str, ...], *, every: int = 1, iterations: int = ITERATIONS
    ) -> Correction:
        """Return ``start`` with the named parameters moved to the least robust sum of squares nearby."""
        current, residuals = start, self.residuals(start, every=every)
        for _ in range(iterations):
            step = self._step(current, residuals, names, every)
            walked = self._walk(current, residuals, step, every) if step else None
            if walked is None:
                break
            current, residuals = walked
            if max(abs(value) / PARAMETERS[name] for name, value in step.items()) < CONVERGED:
                break
        return current

    def _step(self, at: Correction, here: Residuals, names: tuple[str, ...], every: int) -> dict[str, float]:
        """Return the Gauss-Newton step: iteratively reweighted, with the residuals' own spread as their scale.

        Empty where the samples do not determine it.
        """
        columns = []
        for name in names:
            ahead = self.residuals(at.moved({name: PARAMETERS[name]}), every=every)
            columns.append((ahead.normalised - here.normalised) / PARAMETERS[name])
        jacobian = np.stack(columns, axis=-1)
        usable = np.isfinite(here.normalised) & np.isfinite(jacobian).all(axis=-1)
        if usable.sum() < LEAST_SAMPLES:
            return {}
        e, jacobian = here.normalised[usable], jacobian[usable]
        spread = max(1.0, 1.4826 * float(np.median(np.abs(e))))
        weights = 1 / (1 + (e / spread) ** 2) ** 2
        # A derivative that spans an edge is no derivative.
        weights *= np.abs(jacobian).max(axis=1) < 20 * np.median(np.abs(jacobian).max(axis=1)) + 1e-12
        normal = jacobian.T @ (weights[:, None] * jacobian)
        scale = np.sqrt(np.diag(normal))
        if not (scale > 0).all():
            return {}
        normal = normal / np.outer(scale, scale)
        if np.linalg.cond(normal) > 1e8:
            return {}
        step = -np.linalg.solve(normal, jacobian.T @ (weights * e) / scale) / scale
        return {name: float(np.clip(value, *_LONGEST[name])) for name, value in zip(names, step, strict=True)}

    def _walk(
        self, at: Correction, here: Residuals, step: dict[str, float], every: int
    ) -> tuple[Correction, Residuals] | None:
        """Return the correction after the longest of some shares of a step that lowers the residuals, and those."""
        for share in (1.0, 0.5, 0.2):
            moved = at.moved({name: share * value for name, value in step.items()})
            there = self.residuals(moved, every=every)
            if _is_closer(there, here):
                return moved, there
        return None


_LONGEST = {name: (-10.0, 10.0) if name in ("cx", "cy") else (-0.1, 0.1) for name in PARAMETERS}


def mean_cost(residuals: Residuals, sigma_factor: float = 1.0) -> float:
    """Return the mean cost of the samples of the blocks that have poses."""
    if not residuals.known.any():
        return float("inf")
    return float(residuals.costs(sigma_factor)[residuals.known].mean())


def _is_closer(trial: Residuals, reference: Residuals) -> bool:
    """Tell whether the samples that meet a surface in both do so better, so that the image's border does not count."""
    both = np.isfinite(trial.normalised) & np.isfinite(reference.normalised)
    if both.sum() < LEAST_SAMPLES:
        return False
    new, old = np.abs(trial.normalised[both]), np.abs(reference.normalised[both])
    sigma = max(1.0, 0.5 * float(np.median(old)))
    return bool(np.log1p((new / sigma) ** 2).mean() < np.log1p((old / sigma) ** 2).mean())
