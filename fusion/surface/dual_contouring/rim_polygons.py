"""What lies around rim edges: the parts of their quads in the cells that were seen.

Around an edge's 1-D point they are a fan: a triangle with the vertices of each two seen cells beside each other, by way
of the one on the face between them where that is pinned. At either end of the fan is a face beyond which nothing was
seen. The curve on it, which the mesh ends with, goes on to another rim edge, and the triangle of the cell's vertex with
both 1-D points belongs to the fan that the surface comes to first, going counter-clockwise; or to each of both fans a
half, where the curve is pinned.

All of this is within the cells' hulls and the envelopes of ``quad_split``, so the mesh does not meet itself there.
"""

import warp as wp

from fusion.devices import launch_in_slabs, sum_before
from fusion.surface.dual_contouring.dual_grid import DualGrid, place_of
from fusion.surface.dual_contouring.faces import curve_edges, curve_from, face_u, face_v, pattern_of
from fusion.surface.dual_contouring.quad_pins import has_pins, pins_around
from fusion.surface.dual_contouring.rim import (
    cell_at,
    cells_around,
    rim_along,
    rim_vertex,
    steps_back,
    vertex_in_cell,
)
from fusion.surface.layers import (
    NONE,
    corners_back,
    launch_over_layers,
    lowest_bit,
    step_along,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def seen_around(here: wp.vec4ul, under: wp.vec4ul, axis: int, bit: int) -> int:
    """Return which of the four cells around an edge were seen, a bit each, from the words of active cells."""
    around = cells_around(here, under, axis)
    seen = int(0)
    for cell in range(4):
        seen |= int((around[cell] >> wp.uint64(bit)) & wp.uint64(1)) << cell
    return seen


@wp.struct
class RimLayer:
    """Words of the cells at a layer's edges, and whether its quads may pass pins."""

    here: wp.vec4ul
    under: wp.vec4ul
    pinned: bool


@wp.struct
class RimEdge:
    """Which cells around an edge were ``seen``, whether its triangles are ``flipped``, and the ``pins`` there."""

    seen: int
    flipped: bool
    pins: wp.vec4i


@wp.func
def rim_layer(grid: DualGrid, layer: int) -> RimLayer:
    """Look up what a layer's edges have in common."""
    found = RimLayer()
    found.here = corners_back(grid.cells.active, grid.cells.lower, layer >> 3, layer & 7)
    found.under = corners_back(grid.cells.active, grid.cells.lower, layer >> 3, (layer & 7) - 1)
    found.pinned = has_pins(grid, layer >> 3, layer & 7)
    return found


@wp.func
def rim_edge(grid: DualGrid, words: RimLayer, layer: int, axis: int, bit: int) -> RimEdge:
    """Return what lies around the edge along an axis from a layer's voxel."""
    edge = RimEdge()
    edge.seen = seen_around(words.here, words.under, axis, bit)
    edge.flipped = ((grid.cells.inside[layer] >> wp.uint64(bit)) & wp.uint64(1)) == NONE
    edge.pins = wp.vec4i(-1, -1, -1, -1)
    if words.pinned:
        edge.pins = pins_around(grid, layer >> 3, layer & 7, bit, axis)
    return edge


@wp.func
def is_seen(seen: int, cell: int) -> bool:
    """Return whether a cell was seen, counted around from 0 to 3 and on."""
    return ((seen >> (cell & 3)) & 1) == 1


@wp.func
def rim_vertex_across(grid: DualGrid, slot: int, voxel: wp.vec3i, axis: int, cell: int, side: int) -> int:
    """Return the number of the vertex that a curve leads to on a face beyond which nothing was seen.

    The curve comes from a voxel's edge, around which the face, ``side``, is the one after cell ``side``, and ``cell``
    the seen one beside it.
    """
    across = wp.where((side & 1) == 0, (axis + 1) % 3, (axis + 2) % 3)
    face = voxel
    if side == 1:
        face = voxel - step_along((axis + 1) % 3)
    if side == 2:
        face = voxel - step_along((axis + 2) % 3)
    # The edge is on the face's high side where the face is behind the voxel.
    high = wp.where(side == 1 or side == 2, 1, 0)
    holder = place_of(grid.cells.lower, slot, face[0], face[1], face[2])
    own = wp.vec3i(holder[1] & 7, holder[1] >> 3, holder[0] & 7)
    pattern = pattern_of(grid, holder[0] >> 3, own, across)
    along_u = axis == face_u(across)
    edge = wp.where(along_u, high, 2 + high)
    ends = curve_edges(pattern, curve_from(pattern, along_u, high))
    other = wp.where(ends[0] == edge, ends[1], ends[0])
    step = wp.vec3i()
    if other == 1:
        step = step_along(face_v(across))
    if other == 3:
        step = step_along(face_u(across))
    at = own + step
    place = place_of(grid.cells.upper, holder[0] >> 3, at[0], at[1], at[2])
    other_axis = wp.where(other < 2, face_u(across), face_v(across))
    back = (face + step) - (voxel - steps_back(axis, cell))
    return rim_vertex(grid, place[0], other_axis, place[1], cell_at(other_axis, back))


@wp.func
def set_triangle(triangles: wp.array2d(dtype=int), number: int, a: int, b: int, c: int, flipped: bool) -> int:
    """Write a triangle, turned around where it is ``flipped``, and return the next one's number."""
    triangles[number, 0] = a
    triangles[number, 1] = wp.where(flipped, c, b)
    triangles[number, 2] = wp.where(flipped, b, c)
    return number + 1


@wp.func
def triangles_around(edge: RimEdge) -> int:
    """Return how many triangles ``write_fans`` writes around a rim edge."""
    count = int(0)
    for side in range(4):
        before = is_seen(edge.seen, side)
        after = is_seen(edge.seen, side + 1)
        pinned = edge.pins[side] >= 0
        if before and after:
            count += wp.where(pinned, 2, 1)
        elif (before or after) and (pinned or before == edge.flipped):
            count += 1
    return count


@wp.func
def write_fans(
    grid: DualGrid,
    slot: int,
    voxel: wp.vec3i,
    axis: int,
    edge: RimEdge,
    first_pin: int,
    first_rim: int,
    number: int,
    triangles: wp.array2d(dtype=int),
) -> int:
    """Write the triangles around a rim edge from a ``number`` on, and return the next one's."""
    seen = edge.seen
    flipped = edge.flipped
    pins = edge.pins
    layer = 8 * slot + voxel[2]
    bit = 8 * voxel[1] + voxel[0]
    around = wp.vec4i()
    middles = wp.vec4i()
    for cell in range(4):
        if is_seen(seen, cell):
            around[cell] = vertex_in_cell(grid, slot, voxel, axis, cell)
            middles[cell] = first_rim + rim_vertex(grid, layer, axis, bit, cell)
    for side in range(4):
        following = (side + 1) & 3
        before = is_seen(seen, side)
        after = is_seen(seen, following)
        if before and after:
            if pins[side] >= 0:
                pin = first_pin + pins[side]
                number = set_triangle(triangles, number, middles[side], around[side], pin, flipped)
                number = set_triangle(triangles, number, middles[side], pin, around[following], flipped)
            else:
                number = set_triangle(triangles, number, middles[side], around[side], around[following], flipped)
        elif (before or after) and (pins[side] >= 0 or before == flipped):
            # Of both fans' ends at the curve, one is its fan's first as the surface faces.
            cell = wp.where(before, side, following)
            last = first_pin + pins[side]
            if pins[side] < 0:
                last = first_rim + rim_vertex_across(grid, slot, voxel, axis, cell, side)
            # Counter-clockwise the cell comes before the face that follows it, and after the one before it.
            number = set_triangle(triangles, number, middles[cell], around[cell], last, flipped != after)
    return number


@wp.kernel
def _count_triangles(first: int, grid: DualGrid, starts: wp.array(dtype=int)) -> None:
    layer = wp.tid() + first
    if grid.rim_starts[layer] == grid.rim_starts[layer + 1]:
        return
    words = rim_layer(grid, layer)
    count = int(0)
    for axis in range(3):
        left = rim_along(grid, layer, axis)
        while left != NONE:
            bit = lowest_bit(left)
            count += triangles_around(rim_edge(grid, words, layer, axis, bit))
            left = left & (left - wp.uint64(1))
    starts[layer] = count


@wp.kernel
def _write_triangles(
    first: int,
    grid: DualGrid,
    starts: wp.array(dtype=int),
    first_pin: int,
    first_rim: int,
    first_triangle: int,
    triangles: wp.array2d(dtype=int),
) -> None:
    layer = wp.tid() + first
    if grid.rim_starts[layer] == grid.rim_starts[layer + 1]:
        return
    words = rim_layer(grid, layer)
    number = first_triangle + starts[layer]
    for axis in range(3):
        left = rim_along(grid, layer, axis)
        while left != NONE:
            bit = lowest_bit(left)
            edge = rim_edge(grid, words, layer, axis, bit)
            voxel = wp.vec3i(bit & 7, bit >> 3, layer & 7)
            number = write_fans(grid, layer >> 3, voxel, axis, edge, first_pin, first_rim, number, triangles)
            left = left & (left - wp.uint64(1))


def count_rim_triangles(grid: DualGrid, rim: int) -> tuple[wp.array, int]:
    """Return how many triangles around rim edges come before each layer (layers,), and how many there are.

    ``rim`` is how many vertices are on these.
    """
    device, layers = grid.several.device, len(grid.several)
    starts = wp.zeros(layers + 1 if rim else 0, dtype=int, device=device)
    if not rim:
        return starts, 0
    launch_over_layers(_count_triangles, dim=layers, inputs=[grid], outputs=[starts], device=device)
    sum_before(starts)
    return starts, int(starts[layers:].numpy()[0])


def write_rim_triangles(
    grid: DualGrid, starts: wp.array, triangles: wp.array, *, first_pin: int, first_rim: int, first_triangle: int
) -> None:
    """Write the triangles around rim edges behind the first ones, given the numbers of a first pin and rim vertex."""
    launch_in_slabs(
        _write_triangles,
        dim=max(len(starts) - 1, 0),
        inputs=[grid, starts, first_pin, first_rim, first_triangle],
        outputs=[triangles],
        device=triangles.device,
        least_slab=256,
    )
