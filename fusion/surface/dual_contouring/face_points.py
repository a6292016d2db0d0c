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
from fusion.surface.dual_contouring.dual_grid import Counts, DualGrid
from fusion.surface.dual_contouring.faces import (
    curve_edges,
    edge_number_on_face,
    is_ambiguous,
    outside_corner,
    pattern_of,
    point_on_edge,
)
from fusion.surface.dual_contouring.line_search import line_meets_zero, line_search
from fusion.surface.dual_contouring.oracle import Oracle, is_known
from fusion.surface.layers import NONE, lowest_bit, number_of
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_FLAT = wp.constant(2.0e-3)
"""Of a voxel: a curve that is so near to m is straight."""
_SHALLOW = wp.constant(0.02)
"""Below this t the tangents are taken to meet at 2·t, as those of any shallow arc do."""
_BEYOND = wp.constant(1.0)
"""Voxels: so far a curve's apex may lie outside its face."""
_SHORTEST = wp.constant(1.0e-3)


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


@wp.func
def in_face(origin: wp.vec3, axis: int, at: wp.vec2) -> wp.vec3:
    """Return a point of a face across ``axis`` from ``origin``."""
    if axis == 0:
        return origin + wp.vec3(0.0, at[0], at[1])
    if axis == 1:
        return origin + wp.vec3(at[0], 0.0, at[1])
    return origin + wp.vec3(at[0], at[1], 0.0)


@cache
def _asker(value: Any, state_type: Any) -> Any:
    """Return the function that asks an oracle for a point of a face across ``axis`` from ``origin``."""

    @wp.func
    def ask(state: state_type, number: int, origin: wp.vec3, axis: int, at: wp.vec2) -> float:
        return value(state, number, in_face(origin, axis, at))

    return ask


@cache
def _searcher(value: Any, state_type: Any) -> Any:
    """Return the function that asks along a line in a face where the sign changes."""
    ask, search_line = _asker(value, state_type), line_search(value, state_type)

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
        origin_there = in_face(origin, axis, start)
        way_there = in_face(wp.vec3(), axis, way)
        first = line_meets_zero(low, high, at_low, at_high)
        return search_line(state, number, origin_there, way_there, low, high, at_low, at_high, first)

    return search


@cache
def _finder(value: Any, state_type: Any) -> Any:
    """Return the function that finds a curve's 2-D point."""
    ask, search = _asker(value, state_type), _searcher(value, state_type)

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

    return curve_point


@cache
def face_kernel(value: Any, state_type: Any) -> Kernel:
    """Return the kernel that asks an oracle for the curves' 2-D points; a thread takes a layer."""
    curve_point = _finder(value, state_type)

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
        curve = grid.curve_starts[layer]
        if curve == grid.curve_starts[layer + 1]:
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
