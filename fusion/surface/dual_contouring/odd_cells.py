"""Odd cells: those with other than one vertex for all of their crossed edges, found and given their codes."""

import warp as wp

from fusion.surface.dual_contouring.cell_table import COUNT_SHIFT, NO_VERTEX, CellTables
from fusion.surface.dual_contouring.dual_grid import DualGrid
from fusion.surface.dual_contouring.edge_words import EdgeWords, complete_edges, crossed_edges, edge_has
from fusion.surface.layers import NONE, below, case_of, corners_on, lowest_bit

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_FOUR_BITS = wp.constant(wp.uint64(15))
_ALL_NONE = wp.constant(wp.uint64(sum(NO_VERTEX << 4 * edge for edge in range(12))))
_COUNT_SHIFT = wp.constant(wp.uint64(COUNT_SHIFT))


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


@wp.func
def broken_cells(crossed: EdgeWords, complete: EdgeWords) -> wp.uint64:
    """Return the cells where not all crossed edges are complete."""
    broken = NONE
    for edge in range(12):
        broken |= crossed[edge] & ~complete[edge]
    return broken


@wp.func
def broken_code(tables: CellTables, case: int, complete: EdgeWords, bit: int) -> wp.uint64:
    """Return the code of a cell where not all edges are complete: each arc of its loops has a vertex of its own."""
    code = _ALL_NONE
    vertices = int(0)
    for loop in range(tables.loop_counts[case]):
        start = tables.ends[case, loop]
        length = tables.ends[case, loop + 1] - start
        gap = int(-1)
        for i in range(length):
            if not edge_has(complete, tables.edges[case, start + i], bit):
                gap = i
        within = bool(False)
        if gap < 0:
            gap = length - 1
            within = True
            vertices += 1
        for step in range(length):
            edge = tables.edges[case, start + (gap + 1 + step) % length]
            if edge_has(complete, edge, bit):
                if not within:
                    vertices += 1
                within = True
                shift = wp.uint64(4 * edge)
                code = (code & ~(_FOUR_BITS << shift)) | (wp.uint64(vertices - 1) << shift)
            else:
                within = False
    return code | (wp.uint64(vertices) << _COUNT_SHIFT)


@wp.func
def code_of(tables: CellTables, case: int, complete: EdgeWords, broken: wp.uint64, bit: int) -> wp.uint64:
    """Return a cell's code, for the cells that are ``broken``."""
    if ((broken >> wp.uint64(bit)) & wp.uint64(1)) != NONE:
        return broken_code(tables, case, complete, bit)
    return tables.codes[case]


@wp.func
def cell_code(grid: DualGrid, tables: CellTables, layer: int, bit: int, case: int) -> wp.uint64:
    """Return the code of an active cell, once those of odd cells are written."""
    if ((grid.odd[layer] >> wp.uint64(bit)) & wp.uint64(1)) != NONE:
        return grid.codes[grid.vertex_starts[layer][1] + wp.bit_count(grid.odd[layer] & below(bit))]
    return tables.codes[case]


@wp.func
def vertices_of(code: wp.uint64) -> int:
    """Return how many vertices a cell has, from its code."""
    return int(code >> _COUNT_SHIFT)


@wp.kernel
def find_odd_cells(first: int, tables: CellTables, grid: DualGrid) -> None:
    """Find a layer's cells with several loops, with ambiguous faces and the odd ones; count vertices and odd cells."""
    layer = wp.tid() + first
    slot = layer >> 3
    z = layer & 7
    active = grid.cells.active[layer]
    several = NONE
    odd = NONE
    twice = NONE
    vertices = wp.bit_count(active)
    if active != NONE:
        low = corners_on(grid.cells.inside, grid.cells.upper, slot, z)
        high = corners_on(grid.cells.inside, grid.cells.upper, slot, z + 1)
        complete = complete_edges(grid, slot, z)
        broken = broken_cells(crossed_edges(low, high), complete)
        twice = crossed_twice(low) | crossed_twice(wp.vec4ul(low[0], low[2], high[0], high[2]))
        twice |= crossed_twice(wp.vec4ul(low[0], low[1], high[0], high[1]))
        left = active & (broken | maybe_several(low, high))
        while left != NONE:
            bit = lowest_bit(left)
            one = left & (~left + wp.uint64(1))
            case = case_of(low, high, bit)
            if tables.loop_counts[case] > 1:
                several |= one
            if ((several | broken) & one) != NONE:
                odd |= one
                vertices += vertices_of(code_of(tables, case, complete, broken, bit)) - 1
            left = left ^ one
    grid.several[layer] = several
    grid.twice[layer] = active & twice
    grid.odd[layer] = odd
    grid.vertex_starts[layer] = wp.vec2i(vertices, wp.bit_count(odd))


@wp.kernel
def write_odd_cells(first: int, tables: CellTables, grid: DualGrid) -> None:
    """Write the codes of a layer's odd cells."""
    layer = wp.tid() + first
    left = grid.odd[layer]
    if left == NONE:
        return
    slot = layer >> 3
    z = layer & 7
    low = corners_on(grid.cells.inside, grid.cells.upper, slot, z)
    high = corners_on(grid.cells.inside, grid.cells.upper, slot, z + 1)
    complete = complete_edges(grid, slot, z)
    broken = broken_cells(crossed_edges(low, high), complete)
    number = grid.vertex_starts[layer][1]
    more = int(0)
    while left != NONE:
        bit = lowest_bit(left)
        code = code_of(tables, case_of(low, high, bit), complete, broken, bit)
        more += vertices_of(code) - 1
        grid.codes[number] = code
        grid.more[number] = more
        number += 1
        left = left & (left - wp.uint64(1))
