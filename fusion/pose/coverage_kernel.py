"""Coverage of pixels by the model's silhouette: the one kernel that Warp differentiates."""

from typing import Any

import warp as wp

from fusion.volume.trilinear import Corners

# Its backward pass is wanted: this module has it, others leave it out, which halves their compile time.
wp.set_module_options({"enable_backward": True, "max_unroll": 1})


@wp.struct
class NearestApproach:
    """Where a pixel's ray comes nearest to the surface, and the field about that place.

    ``point`` local, metres; the field's trilinear ``terms``, metres, of the cell whose low corner is at ``low`` and
    whose size is 1 / ``cells_per_metre``; ``pixels_per_metre`` at the point's depth. ``known`` is 0 where none is.
    """

    point: wp.vec3
    terms: Corners
    low: wp.vec3
    cells_per_metre: float
    pixels_per_metre: float
    known: int


@wp.func
def distance_in_cell(terms: Corners, at: wp.vec3) -> float:
    """Return the trilinear field at a position in its cell."""
    low = terms[0] + terms[1] * at[0] + (terms[2] + terms[3] * at[0]) * at[1]
    high = terms[4] + terms[5] * at[0] + (terms[6] + terms[7] * at[0]) * at[1]
    return low + high * at[2]


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
    twists: wp.array(dtype=wp.spatial_vector),
    pivot: wp.vec3,
    softness_px: float,
    coverage: wp.array(dtype=float),
    edge_px: wp.array(dtype=float),
) -> None:
    index = wp.tid()
    approach = approaches[index]
    if approach.known == 0:
        coverage[index] = 0.0
        edge_px[index] = wp.inf
    else:
        point = moved(approach.point, twists[index], pivot)
        at = approach.cells_per_metre * (point - approach.low)
        edge = approach.pixels_per_metre * distance_in_cell(approach.terms, at)
        # Φ(−s/σ) by the error function.
        coverage[index] = 0.5 * (1.0 - wp.erf(edge / (1.41421356 * softness_px)))
        edge_px[index] = edge


COVERAGE_KERNEL: Any = _coverage
