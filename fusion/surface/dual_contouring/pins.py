"""Vertices on faces: where the surface has to pass through a face so that sheets keep apart.

Where cells have one loop and faces are not ambiguous nothing can go wrong. Elsewhere each loop's part of its cell is
the hull of the edges that it crosses: these hulls have no inner point in common (a test goes through all cases). A
vertex lies in its loop's hull, and the straight line from it to the next cell's does not leave the hulls of both where
it passes the face within the hull of the two edges that the curve there joins: beyond the line between their far ends,
where these meet in a corner. Where it does not, the curve is *pinned*: a vertex is put on the face within that hull.
Two curves on a face have hulls without a common point, so that never both of them go along the same line.

The vertex is the 2-D point where that is in the hull, else the middle between the 1-D points, which always is.

Where only one of a face's cells was seen, the mesh ends on the face, along the line between the 1-D points (``rim``).
An oracle may tell of a bend in between: then the curve is pinned at its 2-D point, too, where that is in the hull.
"""

import warp as wp

from fusion.devices import launch_in_slabs, sum_before
from fusion.surface.dual_contouring.dual_grid import DualGrid, curve_number, pin_number, place_of, vertex_of_edge
from fusion.surface.dual_contouring.face_words import (
    delicate_curves,
    face_pattern,
    last_curves,
    layer_words,
    may_be_delicate,
)
from fusion.surface.dual_contouring.faces import (
    curve_edges,
    edge_in_cell,
    edge_number_on_face,
    face_u,
    face_v,
    is_ambiguous,
    pattern_of,
    point_on_edge,
)
from fusion.surface.dual_contouring.vertices import VertexArrays, VertexRoom, Vertices, set_vertex_between
from fusion.surface.layers import NONE, launch_over_layers, lowest_bit, number_of, step_along
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_STRAIGHT = wp.constant(0.02)
"""Voxels: a curve at whose end the mesh ends is straight if its 2-D point is so near to the line between its ends."""


@wp.func
def is_in_hull(point: wp.vec2, ends: wp.vec2i, inset: float) -> bool:
    """Return whether a point of a face is within the hull of the two edges that a curve joins, by an ``inset``."""
    if wp.min(point) < inset or wp.max(point) > 1.0 - inset:
        return False
    if (ends[0] < 2) == (ends[1] < 2):
        return True  # opposite edges: all of the face
    # The corner at which they meet is at v = 0 or 1 by the edge along u, and at u = 0 or 1 by the one along v.
    along_u = wp.where(ends[0] < 2, ends[0], ends[1])
    along_v = wp.where(ends[0] < 2, ends[1], ends[0])
    from_corner = wp.abs(point[0] - float(along_v & 1)) + wp.abs(point[1] - float(along_u & 1))
    return from_corner < 1.0 - inset


@wp.func
def meeting_point(a: wp.vec2, b: wp.vec2, leads: wp.vec4) -> wp.vec2:
    """Return where the lines from a curve's ends meet: its 2-D point."""
    from_a = wp.vec2(leads[0], leads[1]) - a
    from_b = wp.vec2(leads[2], leads[3]) - b
    turn = from_a[0] * from_b[1] - from_a[1] * from_b[0]
    if wp.abs(turn) < 1.0e-6:
        return 0.5 * (a + b)
    across = b - a
    return a + (across[0] * from_b[1] - across[1] * from_b[0]) / turn * from_a


@wp.func
def vertices_at(grid: DualGrid, slot: int, layer: int, bit: int, axis: int, edge: int) -> wp.vec2i:
    """Return the vertices that the cells above and below a face have for one of its edges, −1 for a cell not seen."""
    at = wp.vec3i(bit & 7, bit >> 3, layer & 7) - step_along(axis)
    before = place_of(grid.cells.lower, slot, at[0], at[1], at[2])
    return wp.vec2i(
        vertex_of_edge(grid, layer, bit, edge_in_cell(axis, edge, False)),
        vertex_of_edge(grid, before[0], before[1], edge_in_cell(axis, edge, True)),
    )


@wp.func
def vertices_beside(grid: DualGrid, slot: int, layer: int, bit: int, axis: int, ends: wp.vec2i) -> wp.vec4i:
    """Return the vertices that the cells above and below a face have for the two edges that a curve joins, in turn.

    It is −1 for a cell that was not seen.
    """
    first = vertices_at(grid, slot, layer, bit, axis, ends[0])
    second = vertices_at(grid, slot, layer, bit, axis, ends[1])
    return wp.vec4i(first[0], first[1], second[0], second[1])


@wp.func
def passes_within_hull(
    grid: DualGrid, beside: wp.vec2i, axis: int, ends: wp.vec2i, places: wp.array(dtype=wp.vec3)
) -> bool:
    """Return whether the line between the vertices on both sides of a face passes it within a curve's hull."""
    above = places[beside[0]]
    below = places[beside[1]]
    share = (1.0 - below[axis]) / (1.0 - below[axis] + above[axis])
    point = below + share * (above - below)
    return is_in_hull(wp.vec2(point[face_u(axis)], point[face_v(axis)]), ends, grid.inset)


@wp.func
def ends_on_face(
    grid: DualGrid,
    slot: int,
    voxel: wp.vec3i,
    axis: int,
    ends: wp.vec2i,
    along: wp.array(dtype=float),
) -> wp.vec4:
    """Return the 1-D points of the two edges that a curve joins, in the face."""
    a = point_on_edge(ends[0], along[edge_number_on_face(grid, slot, voxel, axis, ends[0])])
    b = point_on_edge(ends[1], along[edge_number_on_face(grid, slot, voxel, axis, ends[1])])
    return wp.vec4(a[0], a[1], b[0], b[1])


@wp.func
def bends_within_hull(at: wp.vec4, leads: wp.vec4, ends: wp.vec2i, inset: float) -> bool:
    """Return whether a curve's 2-D point is in its hull, and off the line between its ends."""
    a = wp.vec2(at[0], at[1])
    b = wp.vec2(at[2], at[3])
    point = meeting_point(a, b, leads)
    across = b - a
    off = wp.abs(across[0] * (point[1] - a[1]) - across[1] * (point[0] - a[0]))
    return is_in_hull(point, ends, inset) and off > _STRAIGHT * wp.length(across)


@wp.kernel
def _choose_pins(
    first: int,
    grid: DualGrid,
    places: wp.array(dtype=wp.vec3),
    along: wp.array(dtype=float),
    curve_points: wp.array(dtype=wp.vec4),
) -> None:
    layer = wp.tid() + first
    slot = layer >> 3
    grid.pin_starts[layer] = 0
    if curve_points.shape[0] > 0:
        if grid.curve_starts[layer] == grid.curve_starts[layer + 1]:
            return
    elif not may_be_delicate(grid, slot, layer & 7):
        return
    words = layer_words(grid, slot, layer & 7)
    total = int(0)
    for axis in range(3):
        curves = delicate_curves(words, axis)
        last = wp.vec2ul()
        if curve_points.shape[0] > 0:
            last = last_curves(words, axis)
        for curve in range(2):
            pins = NONE
            left = curves[curve] | last[curve]
            while left != NONE:
                bit = lowest_bit(left)
                one = left & (~left + wp.uint64(1))
                voxel = wp.vec3i(bit & 7, bit >> 3, layer & 7)
                ends = curve_edges(face_pattern(words, axis, bit), curve)
                pinned = bool(False)
                if (last[curve] & one) != NONE:
                    leads = curve_points[curve_number(grid, layer, axis, bit) + curve]
                    between = ends_on_face(grid, slot, voxel, axis, ends, along)
                    pinned = bends_within_hull(between, leads, ends, grid.inset)
                else:
                    beside = vertices_at(grid, slot, layer, bit, axis, ends[0])
                    pinned = not passes_within_hull(grid, beside, axis, ends, places)
                if pinned:
                    pins |= one
                left = left ^ one
            grid.pins[2 * layer + curve, axis] = pins
            total += wp.bit_count(pins)
    grid.pin_starts[layer] = total


@wp.kernel
def _place_pins(
    first: int,
    grid: DualGrid,
    blocks: wp.array(dtype=wp.vec3i),
    voxel_size: float,
    along: wp.array(dtype=float),
    curve_points: wp.array(dtype=wp.vec4),
    cells: VertexArrays,
    pins: VertexArrays,
) -> None:
    layer = wp.tid() + first
    if grid.pin_starts[layer] == grid.pin_starts[layer + 1]:
        return
    slot = layer >> 3
    corner = 8 * blocks[number_of(grid.cells, slot)]
    for axis in range(3):
        left = grid.pins[2 * layer, axis] | grid.pins[2 * layer + 1, axis]
        while left != NONE:
            bit = lowest_bit(left)
            voxel = wp.vec3i(bit & 7, bit >> 3, layer & 7)
            pattern = pattern_of(grid, slot, voxel, axis)
            for curve in range(wp.where(is_ambiguous(pattern), 2, 1)):
                pin = pin_number(grid, layer, axis, bit, curve)
                if pin >= 0:
                    ends = curve_edges(pattern, curve)
                    between = ends_on_face(grid, slot, voxel, axis, ends, along)
                    a = wp.vec2(between[0], between[1])
                    b = wp.vec2(between[2], between[3])
                    point = 0.5 * (a + b)
                    if curve_points.shape[0] > 0:
                        found = meeting_point(a, b, curve_points[curve_number(grid, layer, axis, bit) + curve])
                        if is_in_hull(found, ends, grid.inset):
                            point = found
                    at = corner + voxel
                    place = wp.vec3(float(at[0]), float(at[1]), float(at[2]))
                    place[face_u(axis)] += point[0]
                    place[face_v(axis)] += point[1]
                    around = vertices_beside(grid, slot, layer, bit, axis, ends)
                    set_vertex_between(pin, voxel_size * place, around, cells, pins)
            left = left & (left - wp.uint64(1))


def place_pins(
    volume: Volume,
    grid: DualGrid,
    along: wp.array,
    curve_points: wp.array | None,
    places: wp.array,
    cells: Vertices,
    *,
    room: VertexRoom,
) -> Vertices:
    """Find the pinned curves (``grid.pins``, ``pin_starts``) and return the vertices on them, in ``room``.

    The ``cells``' vertices lie at ``places``; colours and normals are those of the ones beside.
    """
    device, layers = volume.device, len(grid.several)
    if curve_points is None:
        curve_points = wp.empty(0, dtype=wp.vec4, device=device)
    inputs = [grid, places, along, curve_points]
    launch_over_layers(_choose_pins, dim=layers, inputs=inputs, outputs=[], device=device)
    sum_before(grid.pin_starts)
    count = int(grid.pin_starts[layers:].numpy()[0])
    pins = room.take(count)
    launch_in_slabs(
        _place_pins,
        dim=layers if count else 0,
        inputs=[grid, volume.table.blocks, volume.voxel_size, along, curve_points, cells.arrays()],
        outputs=[pins.arrays()],
        device=device,
        least_slab=256,
    )
    return pins
