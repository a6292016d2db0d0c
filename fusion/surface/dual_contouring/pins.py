"""Vertices on faces: where the surface has to pass through a pinned face so that sheets keep apart.

Such a vertex lies within the hull of the two edges that its curve joins: beyond the line between their far ends, where
these meet in a corner. The 2-D point is taken where it is there, else the middle between the 1-D points, which always
is.
"""

import warp as wp

from fusion.devices import launch_in_slabs
from fusion.surface.dual_contouring.cell_table import NO_VERTEX
from fusion.surface.dual_contouring.dual_grid import Counts, DualGrid, cell_number, curve_number, pin_number, place_of
from fusion.surface.dual_contouring.faces import (
    curve_edges,
    edge_number_on_face,
    face_u,
    face_v,
    is_ambiguous,
    pattern_of,
    point_on_edge,
)
from fusion.surface.dual_contouring.qef import INSET
from fusion.surface.dual_contouring.vertices import Vertices, set_vertex_between
from fusion.surface.layers import NONE, lowest_bit, number_of, step_along
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_INSET = wp.constant(INSET)
_NO_VERTEX = wp.constant(NO_VERTEX)


@wp.func
def is_in_hull(point: wp.vec2, ends: wp.vec2i) -> bool:
    """Return whether a point of a face is well within the hull of the two edges that a curve joins."""
    if wp.min(point) < _INSET or wp.max(point) > 1.0 - _INSET:
        return False
    if (ends[0] < 2) == (ends[1] < 2):
        return True  # opposite edges: all of the face
    # The corner at which they meet is at v = 0 or 1 by the edge along u, and at u = 0 or 1 by the one along v.
    along_u = wp.where(ends[0] < 2, ends[0], ends[1])
    along_v = wp.where(ends[0] < 2, ends[1], ends[0])
    from_corner = wp.abs(point[0] - float(along_v & 1)) + wp.abs(point[1] - float(along_u & 1))
    return from_corner < 1.0 - _INSET


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
def vertex_of_edge(grid: DualGrid, layer: int, bit: int, edge: int) -> int:
    """Return the number of the vertex that a cell has for one of its edges, −1 for none."""
    if layer < 0:
        return -1
    if ((grid.cells.active[layer] >> wp.uint64(bit)) & wp.uint64(1)) == NONE:
        return -1
    cell = cell_number(grid, layer, bit)
    own = int((grid.codes[cell] >> wp.uint64(4 * edge)) & wp.uint64(15))
    if own == _NO_VERTEX:
        return -1
    return grid.vertex_starts[cell] + own


@wp.func
def vertices_beside(grid: DualGrid, slot: int, layer: int, bit: int, axis: int, ends: wp.vec2i) -> wp.vec4i:
    """Return the vertices that the cells on both sides of a face have for the two edges that a curve joins."""
    at = wp.vec3i(bit & 7, bit >> 3, layer & 7) - step_along(axis)
    before = place_of(grid.cells.lower, slot, at[0], at[1], at[2])
    return wp.vec4i(
        vertex_of_edge(grid, layer, bit, edge_in_cell(axis, ends[0], False)),
        vertex_of_edge(grid, before[0], before[1], edge_in_cell(axis, ends[0], True)),
        vertex_of_edge(grid, layer, bit, edge_in_cell(axis, ends[1], False)),
        vertex_of_edge(grid, before[0], before[1], edge_in_cell(axis, ends[1], True)),
    )


@wp.kernel
def _place_pins(
    first: int,
    grid: DualGrid,
    blocks: wp.array(dtype=wp.vec3i),
    voxel_size: float,
    along: wp.array(dtype=float),
    curve_points: wp.array(dtype=wp.vec4),
    cell_colors: wp.array(dtype=wp.vec3ub),
    cell_normals: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
    colors: wp.array(dtype=wp.vec3ub),
    normals: wp.array(dtype=wp.vec3),
) -> None:
    layer = wp.tid() + first
    if grid.curve_starts[layer][1] == grid.curve_starts[layer + 1][1]:
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
                    a = point_on_edge(ends[0], along[edge_number_on_face(grid, slot, voxel, axis, ends[0])])
                    b = point_on_edge(ends[1], along[edge_number_on_face(grid, slot, voxel, axis, ends[1])])
                    point = 0.5 * (a + b)
                    if curve_points.shape[0] > 0:
                        found = meeting_point(a, b, curve_points[curve_number(grid, layer, axis, bit) + curve])
                        if is_in_hull(found, ends):
                            point = found
                    place = wp.vec3(
                        float(corner[0] + voxel[0]), float(corner[1] + voxel[1]), float(corner[2] + voxel[2])
                    )
                    place[face_u(axis)] += point[0]
                    place[face_v(axis)] += point[1]
                    around = vertices_beside(grid, slot, layer, bit, axis, ends)
                    set_vertex_between(
                        pin, voxel_size * place, around, cell_colors, cell_normals, points, colors, normals
                    )
            left = left & (left - wp.uint64(1))


def place_pins(
    volume: Volume, grid: DualGrid, counts: Counts, along: wp.array, curve_points: wp.array | None, cells: Vertices
) -> Vertices:
    """Return the vertices on pinned faces, with colours and normals from the ``cells``' vertices beside them."""
    device = volume.device
    pins = Vertices.empty(counts.pins, device)
    if counts.pins == 0:
        return pins
    if curve_points is None:
        curve_points = wp.empty(0, dtype=wp.vec4, device=device)
    launch_in_slabs(
        _place_pins,
        dim=len(grid.cells.starts) - 1,
        inputs=[grid, volume.table.blocks, volume.voxel_size, along, curve_points, cells.colors, cells.normals],
        outputs=[pins.points, pins.colors, pins.normals],
        device=device,
        least_slab=256,
    )
    return pins
