"""Wrong poses to start from."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.rigid import Matrix
from fusion.pose.se3 import perturb


@dataclass(frozen=True, kw_only=True)
class Perturbation:
    """A pose turned by ``degrees`` about a random axis through the model's middle, and shifted by ``metres`` some way.

    Both are the error's size, not a bound of it (the sets of J. Tremblay et al., "Diff-DOPE", ICRA 2024).
    """

    degrees: float
    metres: float


def random_direction(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a unit vector (3,), all directions equally likely."""
    way = rng.normal(size=3)
    return way / np.linalg.norm(way)


def perturbed(
    truth: Matrix, perturbation: Perturbation, *, pivot_world: NDArray[np.floating], rng: np.random.Generator
) -> Matrix:
    """Return a world_from_camera that is off from ``truth`` as ``perturbation`` says, about ``pivot_world`` (3,)."""
    twist = np.zeros(6)
    twist[3:] = np.radians(perturbation.degrees) * random_direction(rng)
    start = perturb(twist, truth, pivot_world=pivot_world)
    # Shifted after it was turned: together in one twist, the turn would bend the shift and shorten it.
    start[:3, 3] += perturbation.metres * random_direction(rng)
    return start
