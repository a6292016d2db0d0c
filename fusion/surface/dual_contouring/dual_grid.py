"""What dual contouring numbers: active cells and their vertices, crossed edges and faces, and the edges that get quads.

An edge is *complete* where all four cells around it were seen: there is a quad. Around the others the border of what
was observed passes (``rim``).

Most cells have one vertex, for all of their crossed edges; those that have several loops have as many. So vertices are
numbered by counting bits, and only cells with several loops are written down one by one.
"""

from dataclasses import dataclass

import warp as wp

from fusion.surface.layers import NONE, Cells, below

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.struct
class DualGrid:
    """The ``cells`` (``starts``: crossed edges and active cells before a layer), and what is found from them.

    ``inset`` is how far vertices keep from borders, in voxels.

    By layers: ``complete_x``, ``…_y``, ``…_z`` (n,) the voxels whose edge is complete; ``several`` (n,) the active
    cells with several loops, and ``twice`` (n,) those with an ambiguous face on their low side; ``vertex_starts``
    (n + 1,) how many cells' vertices and cells with several loops come before, ``quad_starts`` (n + 1,) how many
    complete edges, and ``rim_starts`` (n + 1,) how many vertices on rim edges; ``parted`` (n, 3) the voxels whose rim
    edge along an axis has two vertices; rows of layers without rim edges are not set.

    By cells with several loops: ``codes`` (k,) as in ``CellTable``; ``more`` (k,) how many more vertices the layer's
    cells have, up to this one, than one each.

    By layers and axes, of the faces across an axis from voxels: ``pins`` (2 n, 3) those with a vertex on curve 0 (row
    2·layer) and 1, and ``pin_starts`` (n + 1,) how many such vertices come before; rows of layers without any are not
    set. Where an oracle is asked, ``faces`` (n, 3) those that are crossed beside an active cell, ``ambiguous`` (n, 3)
    those crossed twice, ``curve_starts`` (n + 1,) how many curves come before, and ``answers`` (64 n,) what it says at
    the voxels.
    """

    cells: Cells
    inset: float
    complete_x: wp.array(dtype=wp.uint64)
    complete_y: wp.array(dtype=wp.uint64)
    complete_z: wp.array(dtype=wp.uint64)
    several: wp.array(dtype=wp.uint64)
    twice: wp.array(dtype=wp.uint64)
    vertex_starts: wp.array(dtype=wp.vec2i)
    quad_starts: wp.array(dtype=int)
    rim_starts: wp.array(dtype=int)
    parted: wp.array2d(dtype=wp.uint64)
    codes: wp.array(dtype=wp.uint64)
    more: wp.array(dtype=int)
    pins: wp.array2d(dtype=wp.uint64)
    pin_starts: wp.array(dtype=int)
    faces: wp.array2d(dtype=wp.uint64)
    ambiguous: wp.array2d(dtype=wp.uint64)
    curve_starts: wp.array(dtype=int)
    answers: wp.array(dtype=float)


@dataclass(frozen=True, kw_only=True)
class Counts:
    """How many of each there are; ``vertices`` are those within cells, ``rim`` those on rim edges."""

    edges: int
    vertices: int
    quads: int
    rim: int
    curves: int


@wp.func
def complete_along(grid: DualGrid, layer: int, axis: int) -> wp.uint64:
    """Return the voxels of a layer whose edge along an axis is complete."""
    if axis == 0:
        return grid.complete_x[layer]
    if axis == 1:
        return grid.complete_y[layer]
    return grid.complete_z[layer]


@wp.func
def first_vertex(grid: DualGrid, layer: int, bit: int) -> int:
    """Return the number of an active cell's first vertex."""
    before = below(bit)
    number = grid.vertex_starts[layer][0] + wp.bit_count(grid.cells.active[layer] & before)
    several = grid.several[layer] & before
    if several != NONE:
        number += grid.more[grid.vertex_starts[layer][1] + wp.bit_count(several) - 1]
    return number


@wp.func
def vertex_of_edge(grid: DualGrid, layer: int, bit: int, edge: int) -> int:
    """Return the number of the vertex that a cell has for one of its crossed edges, −1 where it is not active."""
    if layer < 0:
        return -1
    one = wp.uint64(1) << wp.uint64(bit)
    if (grid.cells.active[layer] & one) == NONE:
        return -1
    first = first_vertex(grid, layer, bit)
    if (grid.several[layer] & one) == NONE:
        return first
    code = grid.codes[grid.vertex_starts[layer][1] + wp.bit_count(grid.several[layer] & below(bit))]
    return first + int((code >> wp.uint64(4 * edge)) & wp.uint64(15))


@wp.func
def curve_number(grid: DualGrid, layer: int, axis: int, bit: int) -> int:
    """Return the number of the first curve through a crossed face; a second one follows it."""
    before = below(bit)
    number = grid.curve_starts[layer] + wp.bit_count(grid.faces[layer, axis] & before)
    number += wp.bit_count(grid.ambiguous[layer, axis] & before)
    for other in range(axis):
        number += wp.bit_count(grid.faces[layer, other]) + wp.bit_count(grid.ambiguous[layer, other])
    return number


@wp.func
def pin_number(grid: DualGrid, layer: int, axis: int, bit: int, curve: int) -> int:
    """Return the number of the vertex on a curve through a face, −1 where it has none."""
    if grid.pin_starts[layer] == grid.pin_starts[layer + 1]:
        return -1
    one = wp.uint64(1) << wp.uint64(bit)
    if (grid.pins[2 * layer + curve, axis] & one) == NONE:
        return -1
    before = below(bit)
    number = grid.pin_starts[layer] + wp.bit_count(grid.pins[2 * layer + 1, axis] & before)
    if curve == 1:
        before |= one
    number += wp.bit_count(grid.pins[2 * layer, axis] & before)
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
