"""2-D points: where the surface leads to within the faces between cells, told from questions to an oracle.

A curve of the surface enters a face at one edge and leaves it at another, a and b; m is the middle between them. Asking
along the normal to ab, in the face, leads from m to a point q of the curve. Where the curve is a wedge, lines from a
and b along its sides meet in its apex, the 2-D point. Asked half as far from ab as q is, along ab on both sides, the
wedge is crossed at g and h, which are such lines' second points; similar triangles would tell the apex, but where it
lies far off, or the curve has two, g and h say more. A smooth curve gives about its tangents at a and b. So in either
case ag and bh lie along the surface, and with the same of the next face they span the plane through a 1-D point.
"""

from functools import cache
from typing import Any

import warp as wp

from fusion.devices import Kernel, launch_in_slabs
from fusion.surface.dual_contouring.dual_grid import Counts, DualGrid, place_of
from fusion.surface.dual_contouring.oracle import Oracle, is_known, next_question
from fusion.surface.layers import NONE, lowest_bit, number_of, step_along, vertex_number
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_FLAT = wp.constant(2.0e-3)
"""Of a voxel: a curve that is so near to m is straight."""
_SHALLOW = wp.constant(0.02)
"""Below this t the tangents are taken to meet at 2·t, as those of any shallow arc do."""
_TOLERANCE = wp.constant(1.0e-3)
_MOST_QUESTIONS = wp.constant(12)
_BEYOND = wp.constant(1.0)
"""Voxels: so far a curve's apex may lie outside its face."""
_SHORTEST = wp.constant(1.0e-3)


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
def way_out(point: wp.vec2, way: wp.vec2) -> float:
    """Return how far it is from a point in the unit square to its border."""
    reach = float(2.0)
    for i in range(2):
        if way[i] > 1.0e-6:
            reach = wp.min(reach, (1.0 - point[i]) / way[i])
        if way[i] < -1.0e-6:
            reach = wp.min(reach, -point[i] / way[i])
    return reach


@wp.func
def both(point: wp.vec2) -> wp.vec4:
    """Return a point twice."""
    return wp.vec4(point[0], point[1], point[0], point[1])


@cache
def face_kernel(value: Any, state_type: Any) -> Kernel:
    """Return the kernel that asks an oracle for the curves' 2-D points; a thread takes a layer."""

    @wp.func
    def ask(state: state_type, number: int, origin: wp.vec3, axis: int, at: wp.vec2) -> float:
        point = origin
        if axis == 0:
            point += wp.vec3(0.0, at[0], at[1])
        elif axis == 1:
            point += wp.vec3(at[0], 0.0, at[1])
        else:
            point += wp.vec3(at[0], at[1], 0.0)
        return value(state, number, point)

    @wp.func
    def search(
        state: state_type,
        number: int,
        origin: wp.vec3,
        axis: int,
        start: wp.vec2,
        way: wp.vec2,
        at_start: float,
        first_reach: float,
        most_reach: float,
    ) -> float:
        """Return how far the sign changes from a point, −1 where it does not within ``most_reach``."""
        low = float(0.0)
        at_low = at_start
        high = wp.min(first_reach, most_reach)
        at_high = ask(state, number, origin, axis, start + high * way)
        for _step in range(3):
            if is_known(at_high) and (at_high < 0.0) == (at_start < 0.0) and high < most_reach:
                low = high
                at_low = at_high
                high = wp.min(2.5 * high, most_reach)
                at_high = ask(state, number, origin, axis, start + high * way)
        if not is_known(at_high) or (at_high < 0.0) == (at_start < 0.0):
            return -1.0
        for step in range(_MOST_QUESTIONS):
            s = next_question(low, high, at_low, at_high, step)
            answer = ask(state, number, origin, axis, start + s * way)
            if not is_known(answer):
                return -1.0
            if wp.abs(answer) < 0.2 * _TOLERANCE:
                return s
            if (answer < 0.0) == (at_start < 0.0):
                low = s
                at_low = answer
            else:
                high = s
                at_high = answer
            if high - low < _TOLERANCE:
                return 0.5 * (low + high)
        return 0.5 * (low + high)

    @wp.func
    def curve_point(
        state: state_type, number: int, origin: wp.vec3, axis: int, a: wp.vec2, b: wp.vec2, outside: wp.vec2
    ) -> wp.vec4:
        """Return where the curve from a to b leads to from a, and where from b."""
        m = 0.5 * (a + b)
        length = wp.length(b - a)
        if length < _SHORTEST:
            return both(m)
        tangent = (b - a) / length
        way = wp.vec2(-tangent[1], tangent[0])
        if wp.dot(way, outside - m) < 0.0:
            way = -way
        at_m = ask(state, number, origin, axis, m)
        if not is_known(at_m) or wp.abs(at_m) < _FLAT:
            return both(m)
        if at_m > 0.0:
            way = -way
        t = search(state, number, origin, axis, m, way, at_m, 1.3 * wp.abs(at_m) + 0.01, way_out(m, way) + _BEYOND)
        if t < 0.0:
            return both(m)
        if t < _SHALLOW:
            return both(m + 2.0 * t * way)
        halfway = m + 0.5 * t * way
        at_halfway = ask(state, number, origin, axis, halfway)
        if not is_known(at_halfway) or (at_halfway < 0.0) != (at_m < 0.0):
            return both(m + t * way)
        reach = 0.5 * length
        left = search(state, number, origin, axis, halfway, -tangent, at_halfway, reach, 3.0 * reach)
        right = search(state, number, origin, axis, halfway, tangent, at_halfway, reach, 3.0 * reach)
        g = m + t * way
        h = g
        if left >= 0.0:
            g = halfway - left * tangent
        if right >= 0.0:
            h = halfway + right * tangent
        return wp.vec4(g[0], g[1], h[0], h[1])

    @wp.kernel(module="unique", enable_backward=False, module_options={"max_unroll": 1})
    def search_faces(
        first: int,
        grid: DualGrid,
        blocks: wp.array(dtype=wp.vec3i),
        along: wp.array(dtype=float),
        state: state_type,
        points: wp.array(dtype=wp.vec4),
    ) -> None:
        layer = wp.tid() + first
        curve = grid.curve_starts[layer][0]
        if curve == grid.curve_starts[layer + 1][0]:
            return
        slot = layer >> 3
        number = number_of(grid.cells, slot)
        for axis in range(3):
            left = grid.faces[layer, axis]
            while left != NONE:
                bit = lowest_bit(left)
                voxel = wp.vec3i(bit & 7, bit >> 3, layer & 7)
                corner = 8 * blocks[number] + voxel
                origin = wp.vec3(float(corner[0]), float(corner[1]), float(corner[2]))
                pattern = pattern_of(grid, slot, voxel, axis)
                curves = wp.where(is_ambiguous(pattern), 2, 1)
                for i in range(curves):
                    ends = curve_edges(pattern, i)
                    a = point_on_edge(ends[0], along[edge_number_on_face(grid, slot, voxel, axis, ends[0])])
                    b = point_on_edge(ends[1], along[edge_number_on_face(grid, slot, voxel, axis, ends[1])])
                    outside = outside_corner(pattern, ends[0])
                    points[curve] = curve_point(state, number, origin, axis, a, b, outside)
                    curve += 1
                left = left & (left - wp.uint64(1))

    return search_faces


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


def face_points(volume: Volume, grid: DualGrid, counts: Counts, oracle: Oracle, along: wp.array) -> wp.array:
    """Return the 2-D point of each curve (curves,), as (u, v) from the face's lowest corner, in voxels.

    It may lie outside the face: it tells where the surface leads to from the face's edges.
    """
    points = wp.empty(counts.curves, dtype=wp.vec4, device=volume.device)
    launch_in_slabs(
        face_kernel(oracle.value, oracle.state_type),
        dim=len(grid.cells.starts) - 1,
        inputs=[grid, volume.table.blocks, along, oracle.state],
        outputs=[points],
        device=volume.device,
        least_slab=64,
    )
    return points
