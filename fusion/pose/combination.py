"""Two stages' poses of one view made one, each as sure in every direction as it is known there.

Features fix a pose that an outline hardly does, as that of a scene most of whose outline lies outside the image, and an
outline one that few features hardly do. What a stage says of how well its pose is known weighs it against the other.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from datagen.rigid import inverse, rigid
from fusion.pose.refinement import Refinement
from fusion.pose.se3 import about_pivot, exp_se3, log_se3, skew
from fusion.pose.uncertainty import Uncertainty, uncertainty


def combined(first: Refinement, second: Refinement) -> Refinement:
    """Return the ``second`` stage's refinement, its pose and uncertainty combined with those of the ``first``.

    Their twists about one pivot are weighed by their information, the inverse of their covariances, as of independent
    measurements. The second is returned as it is where either has declined or does not know its uncertainty.
    """
    if first.declined or second.declined or first.uncertainty is None or second.uncertainty is None:
        return second
    pivot, radius = second.uncertainty.pivot_world, second.uncertainty.radius_m
    ours, theirs = (_information(known, pivot) for known in (first.uncertainty, second.uncertainty))
    there = about_pivot(second.world_from_camera @ inverse(first.world_from_camera), pivot)
    twist = np.linalg.solve(ours + theirs, theirs @ log_se3(there))
    moved = about_pivot(exp_se3(twist), -pivot)
    return replace(
        second,
        world_from_camera=rigid(moved @ first.world_from_camera, source="two stages' poses combined"),
        uncertainty=uncertainty(ours + theirs, sigma=1.0, pivot_world=pivot, radius_m=radius),
    )


def _information(known: Uncertainty, pivot_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the information (6, 6) of twists about another pivot, a way d off: about the own one, v is v + d × ω."""
    back = np.eye(6)
    back[:3, 3:] = skew(pivot_world - known.pivot_world)
    scale = np.array([1, 1, 1, known.radius_m, known.radius_m, known.radius_m])
    information = (known.directions.T / known.deviations_m.clip(1e-12) ** 2) @ known.directions
    return np.asarray(back.T @ (scale[:, None] * information * scale) @ back)
