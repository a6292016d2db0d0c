"""Levenberg and Marquardt's damped steps on SE(3), for many poses side by side."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.pose.normal_equations import Normals
from fusion.pose.se3 import perturb

_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-9, 1e6
_LONGEST_TURN = 0.35
"""Radians a step: the linearisation of a rotation holds no farther."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Descent:
    """Where poses came to: ``poses`` (n, 4, 4), the equations there, and the iterations and last steps (metres)."""

    poses: NDArray[np.float64]
    normals: Normals
    iterations: int
    last_steps_m: NDArray[np.float64]


def descend(
    equations: Callable[[NDArray[np.float64]], Normals],
    poses: NDArray[np.float64],
    *,
    pivot_world: NDArray[np.float64],
    radius_m: float,
    iterations: int,
    enough_m: float,
    rough_m: float = 0.0,
    sure_m: float = 0.0,
) -> Descent:
    """Move poses (n, 4, 4) downhill until no point within ``radius_m`` of the pivot moves by ``enough_m`` any more.

    A pose whose step makes its cost greater stays, and is damped more. Where the cost is not smooth to less than
    ``rough_m``, a step no longer than that which does not lead downhill is the last, too; one shorter than ``sure_m``
    is taken for what it is, since the slope knows better than such a cost where the minimum is.
    """
    normals = equations(poses)
    damping = np.full(len(poses), _FIRST_DAMPING)
    steps = np.full(len(poses), np.inf)
    there = np.zeros(len(poses), bool)
    done = 0
    while done < iterations and not there.all():
        done += 1
        twists = _damped_steps(normals, damping, radius_m)
        candidates = perturb(twists, poses, pivot_world=pivot_world)
        found = equations(candidates)
        better = found.cost <= normals.cost
        lengths = np.maximum(np.linalg.norm(twists[:, :3], axis=1), radius_m * np.linalg.norm(twists[:, 3:], axis=1))
        better |= lengths < sure_m
        damping = np.clip(np.where(better, damping / 5, damping * 8), _LEAST_DAMPING, _MOST_DAMPING)
        poses = np.where(better[:, None, None], candidates, poses)
        normals = _choose(better, found, normals)
        steps = np.where(better, lengths, np.minimum(steps, lengths))
        there |= (lengths < enough_m) | (~better & (lengths < rough_m))
    return Descent(poses=poses, normals=normals, iterations=done, last_steps_m=steps)


def _damped_steps(normals: Normals, damping: NDArray[np.float64], radius_m: float) -> NDArray[np.float64]:
    """Return the twists (n, 6) that solve (H + λ diag H) ξ = −g, none longer than the linearisation holds."""
    scale = np.array([1, 1, 1, 1 / radius_m, 1 / radius_m, 1 / radius_m])
    hessian = scale[:, None] * normals.hessian * scale
    diagonal = np.diagonal(hessian, axis1=1, axis2=2)
    # A direction that nothing fixes must not be stepped along: it gets a share of what the others have.
    mean = diagonal.mean(axis=1, keepdims=True)
    damped = hessian + (damping[:, None] * (diagonal + 1e-3 * mean) + 1e-9 * mean + 1e-300)[..., None] * np.eye(6)
    twists = scale * np.linalg.solve(damped, -(scale * normals.gradient)[..., None])[..., 0]
    turns = np.linalg.norm(twists[:, 3:], axis=1)
    shifts = np.linalg.norm(twists[:, :3], axis=1)
    longest = np.maximum(turns / _LONGEST_TURN, shifts / (_LONGEST_TURN * 2 * radius_m))
    return twists / np.maximum(longest, 1)[:, None]


def _choose(better: NDArray[np.bool_], found: Normals, before: Normals) -> Normals:
    """Return for each pose the equations found, where they are better, or those before."""

    def pick(new: NDArray[np.float64], old: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    return Normals(
        hessian=pick(found.hessian, before.hessian),
        gradient=pick(found.gradient, before.gradient),
        cost=pick(found.cost, before.cost),
        known=pick(found.known, before.known),
        inliers=pick(found.inliers, before.inliers),
        weight=pick(found.weight, before.weight),
        squares=pick(found.squares, before.squares),
    )
