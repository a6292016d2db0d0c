"""The point that is nearest to several planes: a quadratic error function, minimised within a cell."""

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

INSET = 1e-3
"""How far, in voxels, vertices keep from the border of their cell, face or edge: sheets never touch there."""

_LOWEST = wp.constant(INSET)
_HIGHEST = wp.constant(1.0 - INSET)
_REGULARISATION = wp.constant(0.01)
"""How much the centroid of the crossings counts, a plane: it decides where the planes leave a direction open."""

_SWEEPS = wp.constant(24)


@wp.struct
class Planes:
    """Planes within a cell, in voxels from its lowest corner: Σ n nᵀ, Σ n (n·p) and Σ n; Σ p of all points, and both
    counts.
    """

    products: wp.mat33
    offsets: wp.vec3
    normals: wp.vec3
    points: wp.vec3
    planes: float
    count: float


@wp.func
def with_plane(planes: Planes, point: wp.vec3, normal: wp.vec3) -> Planes:
    """Return planes with another point and its normal, of any length; without one, only the point counts."""
    planes.points += point
    planes.count += 1.0
    size = wp.length(normal)
    if size > 0.0:
        unit = normal / size
        planes.products += wp.outer(unit, unit)
        planes.offsets += wp.dot(unit, point) * unit
        planes.normals += unit
        planes.planes += 1.0
    return planes


@wp.func
def kept_within(point: wp.vec3) -> wp.vec3:
    """Return a point kept within the cell, off its border."""
    return wp.vec3(
        wp.clamp(point[0], _LOWEST, _HIGHEST),
        wp.clamp(point[1], _LOWEST, _HIGHEST),
        wp.clamp(point[2], _LOWEST, _HIGHEST),
    )


@wp.func
def nearest_to_planes(planes: Planes) -> wp.vec3:
    """Return the point in the cell with the least sum of squared distances to the planes.

    Where they leave it open, it is the one nearest to the points' centroid.
    """
    centroid = planes.points / planes.count
    weight = _REGULARISATION * (planes.planes + 1.0)
    system = planes.products + wp.diag(wp.vec3(weight, weight, weight))
    right = planes.offsets + weight * centroid
    best = wp.inverse(system) * right
    within = kept_within(best)
    if within[0] != best[0] or within[1] != best[1] or within[2] != best[2]:
        # The minimum over a box, a coordinate at a time.
        for _sweep in range(_SWEEPS):
            before = within
            for axis in range(3):
                rest = right[axis]
                for other in range(3):
                    if other != axis:
                        rest -= system[axis, other] * within[other]
                within[axis] = wp.clamp(rest / system[axis, axis], _LOWEST, _HIGHEST)
            if wp.length_sq(within - before) < 1.0e-10:
                return within
    return within
