"""Cells with several loops, each of which has a vertex: found and given their codes."""

import warp as wp

from fusion.surface.dual_contouring.cell_table import CellTables
from fusion.surface.dual_contouring.dual_grid import DualGrid
from fusion.surface.layers import NONE, case_of, corners_on, lowest_bit

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def crossed_twice(corners: wp.vec4ul) -> wp.uint64:
    """Return where a face is ambiguous, from the words of its corners."""
    return (corners[0] ^ corners[1]) & (corners[0] ^ corners[2]) & ~(corners[0] ^ corners[3])


@wp.func
def maybe_several(low: wp.vec4ul, high: wp.vec4ul) -> wp.uint64:
    """Return all cells with several loops, and some others: with an ambiguous face, or the same at opposite corners."""
    found = ~((low[0] ^ high[3]) | (low[1] ^ high[2]) | (low[2] ^ high[1]) | (low[3] ^ high[0]))
    found |= crossed_twice(low) | crossed_twice(high)
    found |= crossed_twice(wp.vec4ul(low[0], low[2], high[0], high[2]))
    found |= crossed_twice(wp.vec4ul(low[1], low[3], high[1], high[3]))
    found |= crossed_twice(wp.vec4ul(low[0], low[1], high[0], high[1]))
    found |= crossed_twice(wp.vec4ul(low[2], low[3], high[2], high[3]))
    return found


@wp.kernel
def find_several_loops(first: int, tables: CellTables, grid: DualGrid) -> None:
    """Find a layer's cells with several loops and those with ambiguous faces; count these cells and vertices."""
    layer = wp.tid() + first
    slot = layer >> 3
    z = layer & 7
    active = grid.cells.active[layer]
    several = NONE
    twice = NONE
    vertices = wp.bit_count(active)
    if active != NONE:
        low = corners_on(grid.cells.inside, grid.cells.upper, slot, z)
        high = corners_on(grid.cells.inside, grid.cells.upper, slot, z + 1)
        twice = crossed_twice(low) | crossed_twice(wp.vec4ul(low[0], low[2], high[0], high[2]))
        twice |= crossed_twice(wp.vec4ul(low[0], low[1], high[0], high[1]))
        left = active & maybe_several(low, high)
        while left != NONE:
            loops = tables.loop_counts[case_of(low, high, lowest_bit(left))]
            if loops > 1:
                several |= left & (~left + wp.uint64(1))
                vertices += loops - 1
            left = left & (left - wp.uint64(1))
    grid.several[layer] = several
    grid.twice[layer] = active & twice
    grid.vertex_starts[layer] = wp.vec2i(vertices, wp.bit_count(several))


@wp.kernel
def write_several_loops(first: int, tables: CellTables, grid: DualGrid) -> None:
    """Write the codes of a layer's cells with several loops."""
    layer = wp.tid() + first
    left = grid.several[layer]
    if left == NONE:
        return
    slot = layer >> 3
    z = layer & 7
    low = corners_on(grid.cells.inside, grid.cells.upper, slot, z)
    high = corners_on(grid.cells.inside, grid.cells.upper, slot, z + 1)
    number = grid.vertex_starts[layer][1]
    more = int(0)
    while left != NONE:
        case = case_of(low, high, lowest_bit(left))
        more += tables.loop_counts[case] - 1
        grid.codes[number] = tables.codes[case]
        grid.more[number] = more
        number += 1
        left = left & (left - wp.uint64(1))
