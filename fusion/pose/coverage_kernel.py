"""Coverage of pixels by the model's silhouette: the one kernel that Warp differentiates."""

from typing import Any

import warp as wp

from fusion.volume.trilinear import Corners

# Its backward pass is wanted: this module has it, others leave it out, which halves their compile time.
wp.set_module_options({"enable_backward": True, "max_unroll": 1})


@wp.struct
class FieldCell:
    """A local point, metres, and the field about it: its trilinear ``terms``, metres, of a cell, and where that is.

    The cell's low corner is at ``low``, its size 1 / ``cells_per_metre``. ``known`` is 0 where there is no field.
    """

    point: wp.vec3
    terms: Corners
    low: wp.vec3
    cells_per_metre: float
    known: int


@wp.struct
class NearestApproach:
    """Where a pixel's ray comes nearest to the surface.

    A trilinear field bends sharply between cells: so the distance there is told by two points of the ray, ``before``
    and ``after``, the first with weight ``share``, such that their mean does not change along the ray; ``offset``,
    metres, makes it the distance at the place. ``pixels_per_metre`` is that at its depth, times what the mean grows too
    slowly by, 0 where the ray never comes near.
    """

    before: FieldCell
    after: FieldCell
    share: float
    offset: float
    pixels_per_metre: float


@wp.func
def distance_in_cell(terms: Corners, at: wp.vec3) -> float:
    """Return the trilinear field at a position in its cell."""
    low = terms[0] + terms[1] * at[0] + (terms[2] + terms[3] * at[0]) * at[1]
    high = terms[4] + terms[5] * at[0] + (terms[6] + terms[7] * at[0]) * at[1]
    return low + high * at[2]


@wp.func
def distance_at(cell: FieldCell, point: wp.vec3) -> float:
    """Return the field at a local point in or near a cell."""
    return distance_in_cell(cell.terms, cell.cells_per_metre * (point - cell.low))


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
        before = distance_at(approach.before, moved(approach.before.point, twists[index], pivot))
        after = distance_at(approach.after, moved(approach.after.point, twists[index], pivot))
        distance = approach.share * before + (1.0 - approach.share) * after + approach.offset
        edge = shares[index] * approach.pixels_per_metre * distance - within_px[index]
        # Φ(−s/σ) by the error function.
        coverage[index] = 0.5 * (1.0 - wp.erf(edge / (1.41421356 * softness_px)))
        edge_px[index] = edge


COVERAGE_KERNEL: Any = _coverage
