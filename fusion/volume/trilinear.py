"""The distance field within a cell: trilinear in its eight corners, so a cubic along a straight ray.

Corner x + 2·y + 4·z of a cell lies at (x, y, z), each 0 or 1; positions within a cell are in voxels from its corner 0.
"""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

Corners: Any = wp.types.vector(length=8, dtype=float)

NO_CROSSING = wp.constant(-1.0)
BACK_FACE = wp.constant(-2.0)

_SOLVER_STEPS = wp.constant(40)
"""A bound that is never reached: bisection alone takes a float's interval down to its rounding in fewer."""

_CONVERGED = wp.constant(1.0e-7)
"""An interval of a ray this small, as a share of its way through the cell, is the rounding of its position."""


@wp.func
def trilinear_terms(v: Corners) -> Corners:
    """Return the coefficients of 1, x, y, xy, z, xz, yz, xyz."""
    return Corners(
        v[0],
        v[1] - v[0],
        v[2] - v[0],
        v[3] - v[2] - v[1] + v[0],
        v[4] - v[0],
        v[5] - v[4] - v[1] + v[0],
        v[6] - v[4] - v[2] + v[0],
        (v[7] - v[6] - v[5] + v[4]) - (v[3] - v[2] - v[1] + v[0]),
    )


@wp.func
def gradient_of_terms(k: Corners, at: wp.vec3) -> wp.vec3:
    """Return the gradient, per voxel, at a position in the cell, of the field with the given terms."""
    x = at[0]
    y = at[1]
    z = at[2]
    return wp.vec3(
        k[1] + k[3] * y + k[5] * z + k[7] * y * z,
        k[2] + k[3] * x + k[6] * z + k[7] * x * z,
        k[4] + k[5] * x + k[6] * y + k[7] * x * y,
    )


@wp.func
def trilinear_gradient(v: Corners, at: wp.vec3) -> wp.vec3:
    """Return the field's gradient, per voxel, at a position in the cell."""
    return gradient_of_terms(trilinear_terms(v), at)


@wp.func
def cubic_along(v: Corners, a: wp.vec3, b: wp.vec3) -> wp.vec4:
    """Return the coefficients, lowest power first, of the field along a + s·(b − a)."""
    k = trilinear_terms(v)
    d = b - a
    constant = (
        k[0]
        + k[1] * a[0]
        + k[2] * a[1]
        + k[4] * a[2]
        + k[3] * a[0] * a[1]
        + k[5] * a[0] * a[2]
        + k[6] * a[1] * a[2]
        + k[7] * a[0] * a[1] * a[2]
    )
    linear = (
        k[1] * d[0]
        + k[2] * d[1]
        + k[4] * d[2]
        + k[3] * (a[0] * d[1] + a[1] * d[0])
        + k[5] * (a[0] * d[2] + a[2] * d[0])
        + k[6] * (a[1] * d[2] + a[2] * d[1])
        + k[7] * (a[0] * a[1] * d[2] + a[0] * a[2] * d[1] + a[1] * a[2] * d[0])
    )
    quadratic = (
        k[3] * d[0] * d[1]
        + k[5] * d[0] * d[2]
        + k[6] * d[1] * d[2]
        + k[7] * (a[0] * d[1] * d[2] + a[1] * d[0] * d[2] + a[2] * d[0] * d[1])
    )
    return wp.vec4(constant, linear, quadratic, k[7] * d[0] * d[1] * d[2])


@wp.func
def cubic_at(c: wp.vec4, s: float) -> float:
    """Return the value of a cubic."""
    return ((c[3] * s + c[2]) * s + c[1]) * s + c[0]


@wp.func
def solve_falling(c: wp.vec4, start: float, end: float) -> float:
    """Return the root of a cubic that is ≥ 0 at ``start``, < 0 at ``end`` and falls between: Newton, kept in bounds."""
    low = float(start)
    high = float(end)
    at_low = cubic_at(c, low)
    at_high = cubic_at(c, high)
    s = low + (high - low) * at_low / (at_low - at_high)
    for _step in range(_SOLVER_STEPS):
        value = cubic_at(c, s)
        if value >= 0.0:
            low = s
        else:
            high = s
        slope = (3.0 * c[3] * s + 2.0 * c[2]) * s + c[1]
        following = 0.5 * (low + high)
        if slope < 0.0:
            newton = s - value / slope
            if newton >= low and newton <= high:
                following = newton
        change = wp.abs(following - s)
        s = following
        if change <= _CONVERGED:
            return s
    return s


@wp.func
def turning_points(c: wp.vec4) -> wp.vec2:
    """Return where in (0, 1) a cubic's slope is 0, in order; 1 in place of those that are not there."""
    # 3·c₃ s² + 2·c₂ s + c₁, solved without cancellation.
    discriminant = c[2] * c[2] - 3.0 * c[3] * c[1]
    first = float(1.0)
    second = float(1.0)
    if discriminant > 0.0:
        q = -(c[2] + wp.where(c[2] < 0.0, -1.0, 1.0) * wp.sqrt(discriminant))
        if wp.abs(q) > wp.abs(3.0 * c[3]):
            # Its root is beyond 1 in size; only the other one can lie within.
            first = c[1] / q
        elif q != 0.0:
            first = q / (3.0 * c[3])
            second = c[1] / q
    if first <= 0.0 or first > 1.0:
        first = 1.0
    if second <= 0.0 or second > 1.0:
        second = 1.0
    return wp.vec2(wp.min(first, second), wp.max(first, second))


@wp.func
def first_crossing(c: wp.vec4) -> float:
    """Return the first s in [0, 1] where a cubic goes from ≥ 0 to < 0, or NO_CROSSING.

    BACK_FACE where it begins below 0 and rises to ≥ 0 first.
    """
    turns = turning_points(c)
    start = float(0.0)
    at_start = c[0]
    for piece in range(3):
        end = float(1.0)
        if piece == 0:
            end = turns[0]
        elif piece == 1:
            end = turns[1]
        at_end = cubic_at(c, end)
        if at_start >= 0.0:
            if at_end < 0.0:
                return solve_falling(c, start, end)
        elif at_end >= 0.0:
            return BACK_FACE
        start = end
        at_start = at_end
    return NO_CROSSING
