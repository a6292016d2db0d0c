"""What a fused frame is off by when it is located in the model like a query, and taking that off a query near it.

A model is never quite what its frames saw: interpolation rounds it, a sensor bends it, and the poses that it was fused
with do not quite agree. Views that lie close together see the same of it, and are led astray alike. The pose of a fused
frame is given, so how far depth moves it away from there is known, and is taken off what was found for a view nearby.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from datagen.rigid import Matrix, inverse, rigid
from fusion.pose.pose_distance import pose_distances
from fusion.pose.reference_frame import ReferenceFrame
from fusion.pose.refinement import Refinement
from fusion.pose.se3 import about_pivot, exp_se3, log_se3
from fusion.pose.uncertainty import Uncertainty

NEAR = 0.5
"""Radians, a shift by the typical depth counting as one: frames farther off see too little of the same."""

_STEP_PX, _ENOUGH_PIXELS = 8, 100
"""Every which row and column of a frame tells its typical depth, and in how many pixels something has to be seen."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceShift:
    """How a frame's pose moves when it is refined: by exp(``twist``) about ``pivot_world``, shrunk by its noise."""

    twist: NDArray[np.float64]
    pivot_world: NDArray[np.float64]


def nearest_reference(references: Sequence[ReferenceFrame], world_from_camera: Matrix) -> ReferenceFrame | None:
    """Return the frame whose pose is nearest, None where none of them is near."""
    best, least = None, NEAR
    for reference in references:
        depth = _typical_depth(reference.depth)
        if depth is not None:
            poses = np.asarray(reference.world_from_camera)[None]
            distance = float(pose_distances(poses, world_from_camera, depth=depth)[0])
            if distance < least:
                best, least = reference, distance
    return best


def _typical_depth(depth: NDArray[np.float32]) -> float | None:
    """Return the median of a depth image, None where nothing is seen."""
    for step in (_STEP_PX, 1):
        some = depth[::step, ::step]
        seen = some[np.isfinite(some) & (some > 0)]
        if len(seen) >= _ENOUGH_PIXELS or (step == 1 and len(seen)):
            return float(np.median(seen))
    return None


def reference_shift(reference: ReferenceFrame, found: Refinement) -> ReferenceShift | None:
    """Return by how much ``found``, where depth has the frame, is off its pose; None where nothing was found.

    A shift that is no larger than its noise is none: shrunk by 1 − 4/χ², χ² its square in units of its covariance
    (James and Stein 1961, the positive part, in six dimensions).
    """
    known = found.uncertainty
    if found.declined or not found.converged or known is None:
        return None
    own = rigid(reference.world_from_camera, source="pose of a fused frame")
    twist = log_se3(about_pivot(found.world_from_camera @ inverse(own), known.pivot_world))
    return ReferenceShift(twist=_shrunk(twist, known), pivot_world=known.pivot_world)


def without_shift(found: Refinement, shift: ReferenceShift) -> Refinement:
    """Return a query's pose without what moved the frame near it, too."""
    moved = about_pivot(exp_se3(-shift.twist), -shift.pivot_world)
    return replace(found, world_from_camera=rigid(moved @ found.world_from_camera, source="corrected pose"))


def _shrunk(twist: NDArray[np.float64], known: Uncertainty) -> NDArray[np.float64]:
    square = float(twist @ np.linalg.solve(known.covariance, twist))
    return twist * max(0.0, 1 - 4 / square) if square > 0 else twist
