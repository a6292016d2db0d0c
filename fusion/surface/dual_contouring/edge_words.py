"""What is true of the edges of a layer's cells, an edge to a word."""

from typing import Any

import warp as wp

from fusion.surface.dual_contouring.dual_grid import DualGrid
from fusion.surface.layers import corners_on

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

EdgeWords: Any = wp.types.vector(length=12, dtype=wp.uint64)
"""For each edge of a cell, as numbered in ``marching_cubes_table``, the cells of a layer where something is true."""


@wp.func
def crossed_edges(low: wp.vec4ul, high: wp.vec4ul) -> EdgeWords:
    """Return for each of a cell's edges the cells where its ends differ, from the layers of the corners."""
    return EdgeWords(
        low[0] ^ low[1],
        low[2] ^ low[3],
        high[0] ^ high[1],
        high[2] ^ high[3],
        low[0] ^ low[2],
        low[1] ^ low[3],
        high[0] ^ high[2],
        high[1] ^ high[3],
        low[0] ^ high[0],
        low[1] ^ high[1],
        low[2] ^ high[2],
        low[3] ^ high[3],
    )


@wp.func
def complete_edges(grid: DualGrid, slot: int, z: int) -> EdgeWords:
    """Return for each of a cell's edges the cells where it is complete, for one layer of cells."""
    x_low = corners_on(grid.complete_x, grid.cells.upper, slot, z)
    x_high = corners_on(grid.complete_x, grid.cells.upper, slot, z + 1)
    y_low = corners_on(grid.complete_y, grid.cells.upper, slot, z)
    y_high = corners_on(grid.complete_y, grid.cells.upper, slot, z + 1)
    z_low = corners_on(grid.complete_z, grid.cells.upper, slot, z)
    return EdgeWords(
        x_low[0],
        x_low[2],
        x_high[0],
        x_high[2],
        y_low[0],
        y_low[1],
        y_high[0],
        y_high[1],
        z_low[0],
        z_low[1],
        z_low[2],
        z_low[3],
    )


@wp.func
def edge_has(words: EdgeWords, edge: int, bit: int) -> bool:
    """Return whether it is true of a cell's edge."""
    return ((words[edge] >> wp.uint64(bit)) & wp.uint64(1)) != wp.uint64(0)
