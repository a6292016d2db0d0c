"""What dual contouring numbers: active cells and their vertices, crossed edges and faces, and the edges that get quads.

An edge is *complete* where all four cells around it were seen: only there is a quad, so that no surface is made up at
the border of what was observed. A loop whose edges are not all complete falls apart into arcs, and each arc has a
vertex of its own: no vertex touches the border twice.

A face is *pinned* where it is ambiguous, or where a cell beside it has several loops. The surface then passes through
vertices on the face, and each loop of such a cell stays within the hull of the edges that it crosses. These hulls have
no inner point in common (a test goes through all cases), so sheets that share a cell do not meet.
"""

from dataclasses import dataclass

import warp as wp

from fusion.surface.layers import NONE, Cells, below

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.struct
class DualGrid:
    """The ``cells`` (``starts``: crossed edges and active cells before a layer), and what is found from them.

    By layers: ``complete_x``, ``…_y``, ``…_z`` (n,) the voxels whose edge is complete; ``several`` (n,) the active
    cells with several loops; across each axis ``faces`` (n, 3) the voxels whose face is crossed beside an active cell,
    ``ambiguous`` (n, 3) those crossed twice, ``pins`` (2 n, 3) those with a vertex on curve 0 (row 2·layer) and 1;
    ``curve_starts`` (n + 1,) how many curves and pins come before, ``quad_starts`` (n + 1,) how many complete edges.

    By active cells: ``cell_at`` (m,) 64·layer + bit; ``codes`` (m,) at bits 4·edge … which of the cell's vertices an
    edge belongs to, NO_VERTEX for none; ``vertex_starts`` (m + 1,) how many vertices come before.
    """

    cells: Cells
    complete_x: wp.array(dtype=wp.uint64)
    complete_y: wp.array(dtype=wp.uint64)
    complete_z: wp.array(dtype=wp.uint64)
    several: wp.array(dtype=wp.uint64)
    faces: wp.array2d(dtype=wp.uint64)
    ambiguous: wp.array2d(dtype=wp.uint64)
    pins: wp.array2d(dtype=wp.uint64)
    curve_starts: wp.array(dtype=wp.vec2i)
    quad_starts: wp.array(dtype=int)
    cell_at: wp.array(dtype=int)
    codes: wp.array(dtype=wp.uint64)
    vertex_starts: wp.array(dtype=int)


@dataclass(frozen=True, kw_only=True)
class Counts:
    """How many of each there are; ``vertices`` are those within cells, ``pins`` those on faces."""

    edges: int
    cells: int
    curves: int
    pins: int
    quads: int
    vertices: int


@wp.func
def cell_number(grid: DualGrid, layer: int, bit: int) -> int:
    """Return the number of an active cell."""
    return grid.cells.starts[layer][1] + wp.bit_count(grid.cells.active[layer] & below(bit))


@wp.func
def curve_number(grid: DualGrid, layer: int, axis: int, bit: int) -> int:
    """Return the number of the first curve through a crossed face; a second one follows it."""
    before = below(bit)
    number = grid.curve_starts[layer][0] + wp.bit_count(grid.faces[layer, axis] & before)
    number += wp.bit_count(grid.ambiguous[layer, axis] & before)
    for other in range(axis):
        number += wp.bit_count(grid.faces[layer, other]) + wp.bit_count(grid.ambiguous[layer, other])
    return number


@wp.func
def pin_number(grid: DualGrid, layer: int, axis: int, bit: int, curve: int) -> int:
    """Return the number of the vertex on a curve through a pinned face, −1 where it has none."""
    one = wp.uint64(1) << wp.uint64(bit)
    if (grid.pins[2 * layer + curve, axis] & one) == NONE:
        return -1
    before = below(bit)
    if curve == 1:
        before |= one & grid.pins[2 * layer, axis]
    number = grid.curve_starts[layer][1] + wp.bit_count(grid.pins[2 * layer, axis] & before)
    number += wp.bit_count(grid.pins[2 * layer + 1, axis] & below(bit))
    for other in range(axis):
        number += wp.bit_count(grid.pins[2 * layer, other]) + wp.bit_count(grid.pins[2 * layer + 1, other])
    return number


@wp.func
def place_of(slots: wp.array2d(dtype=int), slot: int, x: int, y: int, z: int) -> wp.vec2i:
    """Return the layer and bit of a voxel seen from a slot.

    ``slots`` are the ``upper`` or ``lower`` of ``Cells``, for coordinates from 0 to 8 or from −1 to 7. The layer is −1
    where there is no such block.
    """
    outside = ((x >> 3) & 1) | (((y >> 3) & 1) << 1) | (((z >> 3) & 1) << 2)
    holder = slots[slot, outside]
    if holder < 0:
        return wp.vec2i(-1, 0)
    return wp.vec2i(8 * holder + (z & 7), 8 * (y & 7) + (x & 7))
