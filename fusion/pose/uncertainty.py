"""How well a refined pose is known, and in which directions it is not."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

WEAK_RATIO = 10.0
"""A direction is weak where the pose is this much less certain along it than along the median one."""

_NEAR_AXIS = 3.0
"""Radii from the pivot within which the axis of a turn is thought of as the model's own."""

_AXES = ("x", "y", "z")


@dataclass(frozen=True, kw_only=True, eq=False)
class Uncertainty:
    """The spread of a pose about the true one.

    ``covariance`` (6, 6) is that of the twist (v, ω) with true = S exp(ξ) S⁻¹ · found, v in metres and ω in radians
    along the model's axes, S the translation to ``pivot_world``. ``deviations_m`` (6,) ascending, are standard
    deviations along the principal directions, as the motion of a point at ``radius_m`` from the pivot; ``directions``
    (6, 6) are these in rows, (v, ω · radius) of length 1. ``weak`` names in words those that are not fixed.
    """

    covariance: NDArray[np.float64]
    pivot_world: NDArray[np.float64]
    radius_m: float
    deviations_m: NDArray[np.float64]
    directions: NDArray[np.float64]
    weak: tuple[str, ...]

    @property
    def condition(self) -> float:
        """Of the information matrix, in units of motion: the square of greatest over least deviation."""
        return float((self.deviations_m[-1] / self.deviations_m[0]) ** 2)


def uncertainty(
    hessian: NDArray[np.float64], *, sigma: float, pivot_world: NDArray[np.float64], radius_m: float
) -> Uncertainty:
    """Return what the normal equations JᵀWJ (6, 6) of residuals with standard deviation ``sigma`` say.

    Covariance = σ² (JᵀWJ)⁻¹, for independent residuals; neighbouring pixels share some of theirs, so it is a lower
    bound. A direction that no residual fixes has an infinite deviation in truth, and a very large one here.
    """
    scale = np.array([1, 1, 1, 1 / radius_m, 1 / radius_m, 1 / radius_m])
    information = scale[:, None] * hessian * scale
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, 1e-12 * max(values[-1], 1e-300))
    return _of_spread(sigma**2 / values[::-1], vectors.T[::-1], scale, pivot_world, radius_m)


def _of_spread(
    variances: NDArray[np.float64],
    directions: NDArray[np.float64],
    scale: NDArray[np.float64],
    pivot_world: NDArray[np.float64],
    radius_m: float,
) -> Uncertainty:
    """Return the uncertainty of variances (6,) ascending along directions (6, 6), in units of motion."""
    deviations = np.sqrt(np.maximum(variances, 0))
    middle = float(np.sqrt(deviations[2] * deviations[3]))
    covariance = (directions.T * variances) @ directions
    return Uncertainty(
        covariance=scale[:, None] * covariance * scale,
        pivot_world=pivot_world,
        radius_m=radius_m,
        deviations_m=deviations,
        directions=directions,
        weak=tuple(
            describe_direction(direction)
            for direction, deviation in zip(directions, deviations, strict=True)
            if deviation > WEAK_RATIO * middle
        ),
    )


def clustered_uncertainty(
    jacobian: NDArray[np.float64],
    residuals: NDArray[np.float64],
    weights: NDArray[np.float64],
    clusters: NDArray[np.int64],
    *,
    pivot_world: NDArray[np.float64],
    radius_m: float,
    bends: NDArray[np.float64] | None = None,
) -> Uncertainty:
    """Return the uncertainty that residuals show which are alike within clusters, as neighbouring pixels' are.

    ``jacobian`` (n, 6) by the twist, ``residuals`` (n,) in its unit, ``weights`` (n,) robust, ``clusters`` (n,) the
    number of each one's cluster. Covariance = H⁻¹ (Σ gᵢ gᵢᵀ) H⁻¹ · m / (m − 6), with gᵢ = Σ w r J over cluster i of m
    (White 1980; Liang and Zeger 1986): errors that a cluster shares do not average out as noise of single pixels does,
    and six parameters fit m clusters better than the truth does. H is Σ b J Jᵀ, ``bends`` (n,) the derivatives b of
    w r by r (Huber 1964): less than the weights, which stand for them where they are not given, the more of an outlier
    a residual is.
    """
    scale = np.array([1, 1, 1, 1 / radius_m, 1 / radius_m, 1 / radius_m])
    scaled = jacobian * scale
    hessian = ((weights if bends is None else bends)[:, None] * scaled).T @ scaled
    values, vectors = np.linalg.eigh(hessian)
    # Where most residuals are outliers the cost may bend downwards: what it does not fix is known by next to nothing.
    most = float(((weights[:, None] * scaled) * scaled).sum())
    back = (vectors / np.maximum(values, 1e-12 * max(most, 1e-100))) @ vectors.T
    _numbers, cluster = np.unique(clusters, return_inverse=True)
    count = int(cluster.max()) + 1
    slopes = np.zeros((count, 6))
    np.add.at(slopes, cluster, (weights * residuals)[:, None] * scaled)
    covariance = back @ (slopes.T @ slopes) @ back * (count / max(count - 6, 1))
    # Noise of single pixels alone is the least that it can be, where clusters are few.
    alone = float((weights * residuals**2).sum() / weights.sum()) * back
    spread, directions = np.linalg.eigh(0.5 * (covariance + covariance.T) + alone)
    return _of_spread(spread, directions.T, scale, pivot_world, radius_m)


def describe_direction(direction: NDArray[np.float64]) -> str:
    """Name a direction (v, ω · radius) in words: what moves, and along or about which axis of the model.

    Every motion is a screw (Chasles): a shift across ω only moves the axis aside, and where that stays near the model,
    and little is left along it, the motion is a turn.
    """
    shift, turn = float(np.linalg.norm(direction[:3])), float(np.linalg.norm(direction[3:]))
    along = abs(float(direction[:3] @ direction[3:])) / max(turn, 1e-12)
    if turn * _NEAR_AXIS > shift and turn > 3 * along:
        return f"turning about {_axis(direction[3:])}"
    if shift > 3 * turn:
        return f"sliding along {_axis(direction[:3])}"
    return f"sliding along {_axis(direction[:3])} while turning about {_axis(direction[3:])}"


def sense_of_axis(vector: NDArray[np.float64]) -> float:
    """Return 1 where ``vector`` (3,) points the way that its axis is named by, and −1 where it points back."""
    return 1.0 if vector[int(np.argmax(np.abs(vector)))] >= 0 else -1.0


def _axis(vector: NDArray[np.float64]) -> str:
    unit = vector / np.linalg.norm(vector)
    largest = int(np.argmax(np.abs(unit)))
    if abs(unit[largest]) > 0.98:
        return f"the model's {_AXES[largest]}"
    unit = unit * sense_of_axis(unit)
    return "(" + ", ".join(f"{value:.2f}" for value in unit) + ")"
