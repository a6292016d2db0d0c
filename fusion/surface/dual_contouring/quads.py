"""Quads: one around each complete edge, its corners the vertices of the four cells there, cut into triangles.

``quad_split`` says how; a quad that passes a pinned face is a fan around its 1-D point, by way of the vertices there.
"""

from dataclasses import dataclass

import warp as wp
from warp.utils import array_scan

from fusion.devices import launch_in_slabs
from fusion.surface.dual_contouring.cell_points import Vertices
from fusion.surface.dual_contouring.dual_grid import Counts, DualGrid, pin_number, place_of
from fusion.surface.dual_contouring.face_points import face_u
from fusion.surface.dual_contouring.pins import as_bytes, vertex_of_edge
from fusion.surface.dual_contouring.quad_split import FAN, choose_split
from fusion.surface.layers import NONE, lowest_bit, number_of, step_along, vertex_number
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.struct
class Quads:
    """The quads (n,), counter-clockwise around their edges; those that face against that are ``flipped`` (1).

    ``corners`` the numbers of cells' vertices, ``pins`` those of the vertices on the faces between a corner and the
    next, −1 for none. ``splits``: 0 for the diagonal from corner 0, 1 from corner 1, 2 for a fan. ``starts`` (n + 1,)
    how many triangles and fans come before. ``places`` (n,) 192·layer + 64·axis + bit of the edges.
    """

    corners: wp.array(dtype=wp.vec4i)
    pins: wp.array(dtype=wp.vec4i)
    flipped: wp.array(dtype=wp.uint8)
    splits: wp.array(dtype=wp.uint8)
    starts: wp.array(dtype=wp.vec2i)
    places: wp.array(dtype=int)


@wp.func
def cell_around(corner: int, second: int, third: int) -> wp.vec3i:
    """Return the step from an edge's voxel to one of the four cells around it, counter-clockwise about its axis."""
    step = wp.vec3i(0, 0, 0)
    if corner == 1 or corner == 2:
        step -= step_along(second)
    if corner >= 2:
        step -= step_along(third)
    return step


@wp.func
def edge_in_cell_around(corner: int, axis: int, second: int, third: int) -> int:
    """Return which edge of that cell it is."""
    on_second = wp.where(corner == 1 or corner == 2, 1, 0)
    on_third = wp.where(corner >= 2, 1, 0)
    if second < third:
        return 4 * axis + on_second + 2 * on_third
    return 4 * axis + on_third + 2 * on_second


@wp.func
def pin_beside(grid: DualGrid, slot: int, voxel: wp.vec3i, axis: int, normal: int, side: int) -> int:
    """Return the number of the vertex that a quad passes on a face across ``normal`` from a voxel, −1 for none.

    The quad's edge runs along ``axis`` on the low (0) or high (1) ``side`` of the face.
    """
    place = place_of(grid.cells.lower, slot, voxel[0], voxel[1], voxel[2])
    one = wp.uint64(1) << wp.uint64(place[1])
    layer = place[0]
    if ((grid.pins[2 * layer, normal] | grid.pins[2 * layer + 1, normal]) & one) == NONE:
        return -1
    curve = int(0)
    if (grid.ambiguous[layer, normal] & one) != NONE:
        curve = side
        if axis != face_u(normal):
            # Along v the curves go with the inside corners, as in ``cell_table``.
            inside = (grid.cells.inside[layer] & one) != NONE
            curve = wp.where(inside, side, 1 - side)
    return pin_number(grid, layer, normal, place[1], curve)


@wp.kernel
def _make_quads(
    first: int,
    grid: DualGrid,
    along: wp.array(dtype=float),
    places: wp.array(dtype=wp.vec3),
    quads: Quads,
) -> None:
    layer = wp.tid() + first
    quad = grid.quad_starts[layer]
    if quad == grid.quad_starts[layer + 1]:
        return
    slot = layer >> 3
    for axis in range(3):
        second = (axis + 1) % 3
        third = (axis + 2) % 3
        left = grid.complete_z[layer]
        if axis == 0:
            left = grid.complete_x[layer]
        elif axis == 1:
            left = grid.complete_y[layer]
        while left != NONE:
            bit = lowest_bit(left)
            voxel = wp.vec3i(bit & 7, bit >> 3, layer & 7)
            corners = wp.vec4i()
            around = wp.matrix(shape=(4, 3), dtype=float)
            for corner in range(4):
                step = cell_around(corner, second, third)
                cell = voxel + step
                at = place_of(grid.cells.lower, slot, cell[0], cell[1], cell[2])
                vertex = vertex_of_edge(grid, at[0], at[1], edge_in_cell_around(corner, axis, second, third))
                corners[corner] = vertex
                place = places[vertex]
                around[corner] = wp.vec3(
                    place[second] + float(step[second]), place[third] + float(step[third]), place[axis]
                )
            pins = wp.vec4i(
                pin_beside(grid, slot, voxel, axis, second, 0),
                pin_beside(grid, slot, voxel - step_along(second), axis, third, 1),
                pin_beside(grid, slot, voxel - step_along(third), axis, second, 1),
                pin_beside(grid, slot, voxel, axis, third, 0),
            )
            split = int(FAN)
            triangles = int(4)
            for side in range(4):
                if pins[side] >= 0:
                    triangles += 1
            if triangles == 4:
                crossing = along[vertex_number(grid.cells, layer, axis, bit)]
                split = choose_split(around[0], around[1], around[2], around[3], crossing)
                if split != FAN:
                    triangles = 2
            inside = (grid.cells.inside[layer] >> wp.uint64(bit)) & wp.uint64(1)
            quads.corners[quad] = corners
            quads.pins[quad] = pins
            quads.flipped[quad] = wp.where(inside == wp.uint64(1), wp.uint8(0), wp.uint8(1))
            quads.splits[quad] = wp.uint8(split)
            quads.starts[quad] = wp.vec2i(triangles, wp.where(split == FAN, 1, 0))
            quads.places[quad] = 192 * layer + 64 * axis + bit
            quad += 1
            left = left & (left - wp.uint64(1))


@wp.func
def set_triangle(triangles: wp.array2d(dtype=int), number: int, a: int, b: int, c: int, flipped: bool) -> None:
    """Write a triangle, turned around where it is ``flipped``."""
    triangles[number, 0] = a
    triangles[number, 1] = wp.where(flipped, c, b)
    triangles[number, 2] = wp.where(flipped, b, c)


@wp.kernel
def _emit_triangles(first: int, quads: Quads, first_pin: int, first_fan: int, triangles: wp.array2d(dtype=int)) -> None:
    quad = wp.tid() + first
    corners = quads.corners[quad]
    flipped = quads.flipped[quad] == wp.uint8(1)
    start = quads.starts[quad]
    number = start[0]
    split = int(quads.splits[quad])
    if split == FAN:
        middle = first_fan + start[1]
        for side in range(4):
            pin = quads.pins[quad][side]
            following = corners[(side + 1) & 3]
            if pin >= 0:
                set_triangle(triangles, number, middle, corners[side], first_pin + pin, flipped)
                set_triangle(triangles, number + 1, middle, first_pin + pin, following, flipped)
                number += 2
            else:
                set_triangle(triangles, number, middle, corners[side], following, flipped)
                number += 1
    else:
        a = corners[split]
        c = corners[split + 2 - 4 * ((split + 2) >> 2)]
        set_triangle(triangles, number, a, corners[split + 1], c, flipped)
        set_triangle(triangles, number + 1, a, c, corners[(split + 3) & 3], flipped)


@wp.kernel
def _place_fans(
    first: int,
    grid: DualGrid,
    quads: Quads,
    blocks: wp.array(dtype=wp.vec3i),
    voxel_size: float,
    along: wp.array(dtype=float),
    cell_colors: wp.array(dtype=wp.vec3ub),
    cell_normals: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
    colors: wp.array(dtype=wp.vec3ub),
    normals: wp.array(dtype=wp.vec3),
) -> None:
    quad = wp.tid() + first
    if quads.splits[quad] != wp.uint8(FAN):
        return
    fan = quads.starts[quad][1]
    at = quads.places[quad]
    layer = at / 192
    axis = (at / 64) % 3
    bit = at & 63
    corner = 8 * blocks[number_of(grid.cells, layer >> 3)] + wp.vec3i(bit & 7, bit >> 3, layer & 7)
    point = wp.vec3(float(corner[0]), float(corner[1]), float(corner[2]))
    point[axis] += along[vertex_number(grid.cells, layer, axis, bit)]
    color = wp.vec4()
    normal = wp.vec3()
    for i in range(4):
        vertex = quads.corners[quad][i]
        own = cell_colors[vertex]
        color += wp.vec4(float(own[0]), float(own[1]), float(own[2]), 1.0)
        normal += cell_normals[vertex]
    points[fan] = voxel_size * point
    colors[fan] = as_bytes(color)
    normals[fan] = wp.normalize(normal)


@dataclass(frozen=True, kw_only=True)
class CutQuads:
    """Quads cut into ``triangles`` (m, 3), of vertices numbered cells' first, then pins, then those of the ``fans``."""

    triangles: wp.array
    fans: Vertices


def cut_quads(
    volume: Volume, grid: DualGrid, counts: Counts, along: wp.array, places: wp.array, cells: Vertices
) -> CutQuads:
    """Make the quads of the ``cells``' vertices, which lie at ``places`` in their cells, and cut them."""
    device, count = volume.device, counts.quads
    quads = Quads()
    quads.corners = wp.empty(count, dtype=wp.vec4i, device=device)
    quads.pins = wp.empty(count, dtype=wp.vec4i, device=device)
    quads.flipped = wp.empty(count, dtype=wp.uint8, device=device)
    quads.splits = wp.empty(count, dtype=wp.uint8, device=device)
    quads.starts = wp.zeros(count + 1, dtype=wp.vec2i, device=device)
    quads.places = wp.empty(count, dtype=int, device=device)
    layers = len(grid.cells.starts) - 1
    launch_in_slabs(
        _make_quads, dim=layers, inputs=[grid, along, places], outputs=[quads], device=device, least_slab=256
    )
    array_scan(quads.starts, quads.starts, inclusive=False)
    triangle_total, fan_total = (int(total) for total in quads.starts[count:].numpy()[0])
    triangles = wp.empty((triangle_total, 3), dtype=int, device=device)
    launch_in_slabs(
        _emit_triangles,
        dim=count,
        inputs=[quads, counts.vertices, counts.vertices + counts.pins],
        outputs=[triangles],
        device=device,
        least_slab=4096,
    )
    fans = Vertices.empty(fan_total, device)
    launch_in_slabs(
        _place_fans,
        dim=count if fan_total else 0,
        inputs=[grid, quads, volume.table.blocks, volume.voxel_size, along, cells.colors, cells.normals],
        outputs=[fans.points, fans.colors, fans.normals],
        device=device,
        least_slab=4096,
    )
    return CutQuads(triangles=triangles, fans=fans)
