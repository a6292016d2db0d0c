"""The faces between cells: their axes, corners and edges, and the curves that the surface makes through them.

A face across ``axis`` from a voxel has the other two axes u and v, ascending, and edges as in ``cell_table``.
"""

import warp as wp

from fusion.surface.dual_contouring.dual_grid import DualGrid, place_of
from fusion.surface.layers import step_along, vertex_number

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def face_u(axis: int) -> int:
    """Return the first of the other two axes."""
    return wp.where(axis == 0, 1, 0)


@wp.func
def face_v(axis: int) -> int:
    """Return the second of the other two axes."""
    return wp.where(axis == 2, 1, 2)


@wp.func
def is_ambiguous(pattern: int) -> bool:
    """Return whether a face's inside corners lie across from each other."""
    return pattern == 6 or pattern == 9


@wp.func
def edge_of_pattern(pattern: int, edge: int) -> bool:
    """Return whether a face edge is crossed."""
    low = wp.where(edge == 1, 2, wp.where(edge == 3, 1, 0))
    high = wp.where(edge == 0, 1, wp.where(edge == 2, 2, 3))
    return ((pattern >> low) & 1) != ((pattern >> high) & 1)


@wp.func
def curve_edges(pattern: int, curve: int) -> wp.vec2i:
    """Return the two face edges that a curve joins."""
    if is_ambiguous(pattern):
        at_first = wp.where((pattern & 1) == 1, 2, 3)
        return wp.vec2i(curve, wp.where(curve == 0, at_first, 5 - at_first))
    found = wp.vec2i(-1, -1)
    for edge in range(4):
        if edge_of_pattern(pattern, edge):
            if found[0] < 0:
                found[0] = edge
            else:
                found[1] = edge
    return found


@wp.func
def curve_from(pattern: int, along_u: bool, side: int) -> int:
    """Return which curve a crossed face edge is an end of, the one along u, or v, on a ``side`` of the face."""
    if not is_ambiguous(pattern):
        return 0
    # Along v the curves go with the inside corners, as in ``cell_table``.
    return wp.where(along_u or (pattern & 1) == 1, side, 1 - side)


@wp.func
def point_on_edge(edge: int, along: float) -> wp.vec2:
    """Return a point of a face edge in the face."""
    side = float(edge & 1)
    if edge < 2:
        return wp.vec2(along, side)
    return wp.vec2(side, along)


@wp.func
def outside_corner(pattern: int, edge: int) -> wp.vec2:
    """Return the outside one of a crossed face edge's two corners."""
    low = wp.where(edge == 1, 2, wp.where(edge == 3, 1, 0))
    return point_on_edge(edge, float((pattern >> low) & 1))


@wp.func
def edge_in_cell(axis: int, edge: int, beyond: bool) -> int:
    """Return which edge of a cell a face's edge is, for the face across ``axis`` at its low or, ``beyond``, high side.

    Edge 4·axis + k has k = 1 or 3 on the high side of the first other axis, 2 or 3 on that of the second.
    """
    u = face_u(axis)
    v = face_v(axis)
    along = wp.where(edge < 2, u, v)
    across = wp.where(edge < 2, v, u)
    on_across = edge & 1
    on_axis = wp.where(beyond, 1, 0)
    if across < axis:
        return 4 * along + on_across + 2 * on_axis
    return 4 * along + on_axis + 2 * on_across


@wp.func
def edge_number_on_face(grid: DualGrid, slot: int, voxel: wp.vec3i, axis: int, edge: int) -> int:
    """Return the number of the lattice edge that is a face's edge, for a face across ``axis`` from a voxel."""
    u = face_u(axis)
    v = face_v(axis)
    at = voxel
    if edge == 1:
        at = voxel + step_along(v)
    if edge == 3:
        at = voxel + step_along(u)
    place = place_of(grid.cells.upper, slot, at[0], at[1], at[2])
    return vertex_number(grid.cells, place[0], wp.where(edge < 2, u, v), place[1])


@wp.func
def is_inside(grid: DualGrid, slot: int, voxel: wp.vec3i) -> int:
    """Return 1 where a voxel, seen from a slot, is inside."""
    place = place_of(grid.cells.upper, slot, voxel[0], voxel[1], voxel[2])
    return int((grid.cells.inside[place[0]] >> wp.uint64(place[1])) & wp.uint64(1))


@wp.func
def pattern_of(grid: DualGrid, slot: int, voxel: wp.vec3i, axis: int) -> int:
    """Return which corners of the face across ``axis`` from a voxel are inside, as ``face_pattern`` does."""
    u = step_along(face_u(axis))
    v = step_along(face_v(axis))
    pattern = is_inside(grid, slot, voxel)
    pattern |= is_inside(grid, slot, voxel + u) << 1
    pattern |= is_inside(grid, slot, voxel + v) << 2
    return pattern | (is_inside(grid, slot, voxel + u + v) << 3)
