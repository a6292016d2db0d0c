"""Small symmetric systems of equations, solved in kernels."""

from typing import Any

import warp as wp

from fusion.pose.normal_equations import SUMS

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

Sums64: Any = wp.types.vector(length=SUMS, dtype=wp.float64)


@wp.func
def place_in_upper(row: int, column: int) -> int:
    """Return where an entry, ``row`` ≤ ``column``, of a symmetric 6×6 matrix is in its upper triangle, row by row."""
    return row * 6 - row * (row - 1) // 2 + column - row


@wp.func
def solve_symmetric(upper: Sums64, damping: wp.float64) -> wp.spatial_vectord:
    """Return x of (A + damping · 1) x = −b, by Cholesky's factors.

    ``upper`` holds A's upper triangle by rows (21), then b (6).
    """
    low = wp.spatial_matrixd()
    x = wp.spatial_vectord()
    for column in range(6):
        for row in range(column, 6):
            value = upper[place_in_upper(column, row)]
            if row == column:
                value += damping
            for k in range(column):
                value -= low[row, k] * low[column, k]
            if row == column:
                low[row, column] = wp.sqrt(wp.max(value, wp.float64(1e-300)))
            else:
                low[row, column] = value / low[column, column]
    for row in range(6):
        value = -upper[21 + row]
        for k in range(row):
            value -= low[row, k] * x[k]
        x[row] = value / low[row, row]
    for back in range(6):
        row = 5 - back
        value = x[row]
        for k in range(row + 1, 6):
            value -= low[k, row] * x[k]
        x[row] = value / low[row, row]
    return x
