"""Coverage of pixels by the model's silhouette: the one kernel that Warp differentiates."""

from typing import Any

import warp as wp

# Its backward pass is wanted: this module has it, others leave it out, which halves their compile time.
wp.set_module_options({"enable_backward": True, "max_unroll": 1})


@wp.struct
class NearestApproach:
    """Where a pixel's ray comes nearest to the surface: a ``point`` of the ray, and the surface's ``foot``, local.

    ``normal`` points from the foot to the ray: a small motion changes their distance along it alone.
    ``pixels_per_metre`` is what that distance is seen as, 0 where the ray never comes near.
    """

    point: wp.vec3
    foot: wp.vec3
    normal: wp.vec3
    pixels_per_metre: float


@wp.func
def moved(point: wp.vec3, twist: wp.spatial_vector, pivot: wp.vec3) -> wp.vec3:
    """Return a point moved by a small twist about the pivot, right to second order."""
    shift = wp.spatial_top(twist)
    turn = wp.spatial_bottom(twist)
    first = wp.cross(turn, point - pivot)
    return point + shift + first + 0.5 * wp.cross(turn, first)


@wp.kernel
def _coverage(
    approaches: wp.array(dtype=NearestApproach),
    nearest: wp.array(dtype=int),
    within_px: wp.array(dtype=float),
    shares: wp.array(dtype=float),
    twists: wp.array(dtype=wp.spatial_vector),
    pivot: wp.vec3,
    softness_px: float,
    coverage: wp.array(dtype=float),
    edge_px: wp.array(dtype=float),
) -> None:
    index = wp.tid()
    approach = approaches[nearest[index]]
    if approach.pixels_per_metre == 0.0:
        coverage[index] = wp.where(within_px[index] > 0.0, 1.0, 0.0)
        edge_px[index] = wp.where(within_px[index] > 0.0, -wp.inf, wp.inf)
    else:
        point = moved(approach.point, twists[index], pivot)
        distance = wp.dot(approach.normal, point - approach.foot)
        edge = shares[index] * approach.pixels_per_metre * distance - within_px[index]
        # Φ(−s/σ) by the error function.
        coverage[index] = 0.5 * (1.0 - wp.erf(edge / (1.41421356 * softness_px)))
        edge_px[index] = edge


COVERAGE_KERNEL: Any = _coverage
