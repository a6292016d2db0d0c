"""Finding what dual contouring numbers, a layer of voxels at a time."""

from typing import Any

import warp as wp
from warp.utils import array_scan

from fusion.surface.cells import find_cells
from fusion.surface.dual_contouring.cell_table import NO_VERTEX, CellTables, cell_tables
from fusion.surface.dual_contouring.dual_grid import Counts, DualGrid
from fusion.surface.dual_contouring.oracle import Oracle
from fusion.surface.dual_contouring.signs import ask_signs
from fusion.surface.layers import (
    NONE,
    case_of,
    corners_back,
    corners_on,
    launch_over_layers,
    lowest_bit,
)
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

EdgeWords: Any = wp.types.vector(length=12, dtype=wp.uint64)

_FOUR_BITS = wp.constant(wp.uint64(15))
_NO_VERTEX = wp.constant(wp.uint64(NO_VERTEX))
_ALL_NONE = wp.constant(wp.uint64(0xFFFFFFFFFFFF))


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
def broken_code(tables: CellTables, case: int, complete: EdgeWords, bit: int) -> wp.uint64:
    """Return the code of a cell where not all edges are complete; above its 48 bits stands the count of vertices."""
    code = _ALL_NONE
    vertices = int(0)
    for loop in range(tables.loop_counts[case]):
        start = tables.ends[case, loop]
        length = tables.ends[case, loop + 1] - start
        gap = int(-1)
        for i in range(length):
            if ((complete[tables.edges[case, start + i]] >> wp.uint64(bit)) & wp.uint64(1)) == NONE:
                gap = i
        within = bool(False)
        if gap < 0:
            gap = length - 1
            within = True
            vertices += 1
        for step in range(length):
            edge = tables.edges[case, start + (gap + 1 + step) % length]
            if ((complete[edge] >> wp.uint64(bit)) & wp.uint64(1)) != NONE:
                if not within:
                    vertices += 1
                within = True
                shift = wp.uint64(4 * edge)
                code = (code & ~(_FOUR_BITS << shift)) | (wp.uint64(vertices - 1) << shift)
            else:
                within = False
    return code | (wp.uint64(vertices) << wp.uint64(48))


@wp.kernel
def _find_complete(first: int, grid: DualGrid) -> None:
    layer = wp.tid() + first
    slot = layer >> 3
    z = layer & 7
    cells = grid.cells
    x = NONE
    y = NONE
    z_edges = NONE
    if cells.starts[layer][0] != cells.starts[layer + 1][0]:
        here = corners_back(cells.active, cells.lower, slot, z)
        under = corners_back(cells.active, cells.lower, slot, z - 1)
        x = cells.edges[layer, 0] & here[0] & here[2] & under[0] & under[2]
        y = cells.edges[layer, 1] & here[0] & here[1] & under[0] & under[1]
        z_edges = cells.edges[layer, 2] & here[0] & here[1] & here[2] & here[3]
    grid.complete_x[layer] = x
    grid.complete_y[layer] = y
    grid.complete_z[layer] = z_edges
    grid.quad_starts[layer] = wp.bit_count(x) + wp.bit_count(y) + wp.bit_count(z_edges)


@wp.kernel
def _find_vertices(first: int, tables: CellTables, grid: DualGrid) -> None:
    layer = wp.tid() + first
    slot = layer >> 3
    z = layer & 7
    cells = grid.cells
    active = cells.active[layer]
    several = NONE
    if active != NONE:
        low = corners_on(cells.inside, cells.upper, slot, z)
        high = corners_on(cells.inside, cells.upper, slot, z + 1)
        crossed = crossed_edges(low, high)
        complete = complete_edges(grid, slot, z)
        broken = NONE
        for edge in range(12):
            broken |= crossed[edge] & ~complete[edge]
        index = cells.starts[layer][1]
        left = active
        while left != NONE:
            bit = lowest_bit(left)
            one = left & (~left + wp.uint64(1))
            case = case_of(low, high, bit)
            code = tables.codes[case]
            loops = tables.loop_counts[case]
            vertices = loops
            if loops > 1:
                several |= one
            if (broken & one) != NONE:
                code = broken_code(tables, case, complete, bit)
                vertices = int(code >> wp.uint64(48))
            grid.cell_at[index] = 64 * layer + bit
            grid.codes[index] = code
            grid.vertex_starts[index] = vertices
            index += 1
            left = left ^ one
    grid.several[layer] = several


@wp.func
def face_corners(low: wp.vec4ul, high: wp.vec4ul, axis: int) -> wp.vec4ul:
    """Return the words of a face's corners (u, v) = (0, 0), (1, 0), (0, 1), (1, 1)."""
    if axis == 0:
        return wp.vec4ul(low[0], low[2], high[0], high[2])
    if axis == 1:
        return wp.vec4ul(low[0], low[1], high[0], high[1])
    return low


@wp.func
def face_edges(complete: EdgeWords, axis: int) -> wp.vec4ul:
    """Return what is true of a face's edges 0 to 3, of what is true of the edges of the cell above it."""
    if axis == 0:
        return wp.vec4ul(complete[4], complete[6], complete[8], complete[10])
    if axis == 1:
        return wp.vec4ul(complete[0], complete[2], complete[8], complete[9])
    return wp.vec4ul(complete[0], complete[1], complete[4], complete[5])


@wp.func
def back_along(back: wp.vec4ul, under: wp.vec4ul, axis: int) -> wp.uint64:
    """Return what is true one back along an axis, from the words of this layer and the one under it."""
    if axis == 2:
        return under[0]
    return back[axis + 1]


@wp.kernel
def _find_faces(first: int, grid: DualGrid) -> None:
    layer = wp.tid() + first
    slot = layer >> 3
    z = layer & 7
    cells = grid.cells
    active = corners_back(cells.active, cells.lower, slot, z)
    active_under = corners_back(cells.active, cells.lower, slot, z - 1)
    curves = int(0)
    pins = int(0)
    if (active[0] | active[1] | active[2] | active_under[0]) != NONE:
        low = corners_on(cells.inside, cells.upper, slot, z)
        high = corners_on(cells.inside, cells.upper, slot, z + 1)
        complete = complete_edges(grid, slot, z)
        several = corners_back(grid.several, cells.lower, slot, z)
        several_under = corners_back(grid.several, cells.lower, slot, z - 1)
        for axis in range(3):
            corners = face_corners(low, high, axis)
            mixed = (corners[0] | corners[1] | corners[2] | corners[3]) & ~(
                corners[0] & corners[1] & corners[2] & corners[3]
            )
            faces = mixed & (active[0] | back_along(active, active_under, axis))
            twice = faces & (corners[0] ^ corners[1]) & (corners[0] ^ corners[2]) & ~(corners[0] ^ corners[3])
            pinned = faces & (twice | several[0] | back_along(several, several_under, axis))
            edges = face_edges(complete, axis)
            # On an ambiguous face an edge along v goes with the inside corner that it ends at.
            to_first = (corners[0] & edges[2]) | (~corners[0] & edges[3])
            to_second = (corners[0] & edges[3]) | (~corners[0] & edges[2])
            some = edges[0] | edges[1] | edges[2] | edges[3]
            pins_0 = pinned & ((~twice & some) | (twice & (edges[0] | to_first)))
            pins_1 = pinned & twice & (edges[1] | to_second)
            grid.faces[layer, axis] = faces
            grid.ambiguous[layer, axis] = twice
            grid.pins[2 * layer, axis] = pins_0
            grid.pins[2 * layer + 1, axis] = pins_1
            curves += wp.bit_count(faces) + wp.bit_count(twice)
            pins += wp.bit_count(pins_0) + wp.bit_count(pins_1)
    else:
        for axis in range(3):
            grid.faces[layer, axis] = NONE
            grid.ambiguous[layer, axis] = NONE
            grid.pins[2 * layer, axis] = NONE
            grid.pins[2 * layer + 1, axis] = NONE
    grid.curve_starts[layer] = wp.vec2i(curves, pins)


def find_grid(volume: Volume, oracle: Oracle | None, *, min_weight: float) -> tuple[DualGrid, Counts]:
    """Find what dual contouring numbers in a volume; a voxel was seen where its weight is over ``min_weight``.

    Which voxels are inside is the oracle's to say, or without one the volume's.
    """
    device = volume.device
    tables = cell_tables(str(device.alias))
    # Counted in place of triangles: one of each active cell.
    ones = wp.full(256, 1, dtype=int, device=device)
    cells = find_cells(volume, ones, meshed=None, min_weight=min_weight)
    if oracle is not None:
        ask_signs(volume, cells, ones, oracle)
    layers = len(cells.starts) - 1
    edges, active = (int(total) for total in cells.starts[layers:].numpy()[0])
    grid = DualGrid()
    grid.cells = cells
    for name in ("complete_x", "complete_y", "complete_z", "several"):
        setattr(grid, name, wp.empty(layers, dtype=wp.uint64, device=device))
    for name in ("faces", "ambiguous", "pins"):
        rows = 2 * layers if name == "pins" else layers
        setattr(grid, name, wp.empty((rows, 3), dtype=wp.uint64, device=device))
    grid.curve_starts = wp.zeros(layers + 1, dtype=wp.vec2i, device=device)
    grid.quad_starts = wp.zeros(layers + 1, dtype=int, device=device)
    grid.cell_at = wp.empty(active, dtype=int, device=device)
    grid.codes = wp.empty(active, dtype=wp.uint64, device=device)
    grid.vertex_starts = wp.zeros(active + 1, dtype=int, device=device)
    launch_over_layers(_find_complete, dim=layers, inputs=[], outputs=[grid], device=device)
    launch_over_layers(_find_vertices, dim=layers, inputs=[tables], outputs=[grid], device=device)
    launch_over_layers(_find_faces, dim=layers, inputs=[], outputs=[grid], device=device)
    for starts in (grid.curve_starts, grid.quad_starts, grid.vertex_starts):
        array_scan(starts, starts, inclusive=False)
    curves, pins = (int(total) for total in grid.curve_starts[layers:].numpy()[0])
    return grid, Counts(
        edges=edges,
        cells=active,
        curves=curves,
        pins=pins,
        quads=int(grid.quad_starts[layers:].numpy()[0]),
        vertices=int(grid.vertex_starts[active:].numpy()[0]),
    )
