"""Quads: one around each complete edge, its corners the vertices of the four cells there, cut into triangles.

``quad_split`` says how; a quad that passes a pinned face is a fan around its 1-D point, by way of the vertices there.
"""

from dataclasses import dataclass

import warp as wp

from fusion.devices import launch_in_slabs, sum_before
from fusion.surface.dual_contouring.dual_grid import DualGrid, complete_along
from fusion.surface.dual_contouring.layer_quads import split_layer
from fusion.surface.dual_contouring.quad_pins import has_pins, pins_around
from fusion.surface.dual_contouring.quad_split import FAN, WITHOUT_CORNER
from fusion.surface.dual_contouring.vertices import VertexArrays, VertexRoom, Vertices, set_vertex_between
from fusion.surface.layers import NONE, launch_over_layers, lowest_bit, number_of, vertex_number
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.kernel
def _split_quads(
    first: int,
    grid: DualGrid,
    along: wp.array(dtype=float),
    places: wp.array(dtype=wp.vec3),
    corners: wp.array(dtype=wp.vec4i),
    splits: wp.array(dtype=wp.uint8),
    starts: wp.array(dtype=wp.vec2i),
) -> None:
    layer = wp.tid() + first
    quad = grid.quad_starts[layer]
    if quad == grid.quad_starts[layer + 1]:
        return
    slot = layer >> 3
    z = layer & 7
    counts = split_layer(grid, slot, z, along, places, corners, quad, splits)
    if has_pins(grid, slot, z):
        for axis in range(3):
            left = complete_along(grid, layer, axis)
            while left != NONE:
                pins = pins_around(grid, slot, z, lowest_bit(left), axis)
                more = int(0)
                for side in range(4):
                    if pins[side] >= 0:
                        more += 1
                if more > 0:
                    if int(splits[quad]) != FAN:
                        splits[quad] = wp.uint8(FAN)
                        counts += wp.vec2i(2, 1)
                    counts += wp.vec2i(more, 0)
                quad += 1
                left = left & (left - wp.uint64(1))
    starts[layer] = counts


@wp.func
def set_triangle(triangles: wp.array2d(dtype=int), number: int, a: int, b: int, c: int, flipped: bool) -> None:
    """Write a triangle, turned around where it is ``flipped``."""
    triangles[number, 0] = a
    triangles[number, 1] = wp.where(flipped, c, b)
    triangles[number, 2] = wp.where(flipped, b, c)


@wp.kernel
def _emit_triangles(
    first: int,
    grid: DualGrid,
    corners: wp.array(dtype=wp.vec4i),
    splits: wp.array(dtype=wp.uint8),
    starts: wp.array(dtype=wp.vec2i),
    first_pin: int,
    first_fan: int,
    triangles: wp.array2d(dtype=int),
) -> None:
    layer = wp.tid() + first
    quad = grid.quad_starts[layer]
    if quad == grid.quad_starts[layer + 1]:
        return
    number = starts[layer][0]
    middle = first_fan + starts[layer][1]
    for axis in range(3):
        left = complete_along(grid, layer, axis)
        while left != NONE:
            bit = lowest_bit(left)
            # Counter-clockwise about its axis a quad faces where its edge leads out.
            flipped = ((grid.cells.inside[layer] >> wp.uint64(bit)) & wp.uint64(1)) == NONE
            own = corners[quad]
            split = int(splits[quad])
            if split < FAN:
                a = own[split]
                c = own[split + 2]
                set_triangle(triangles, number, a, own[split + 1], c, flipped)
                set_triangle(triangles, number + 1, a, c, own[(split + 3) & 3], flipped)
                number += 2
            elif split == FAN:
                pins = pins_around(grid, layer >> 3, layer & 7, bit, axis)
                for side in range(4):
                    following = own[(side + 1) & 3]
                    if pins[side] >= 0:
                        pin = first_pin + pins[side]
                        set_triangle(triangles, number, middle, own[side], pin, flipped)
                        set_triangle(triangles, number + 1, middle, pin, following, flipped)
                        number += 2
                    elif own[side] != following:
                        set_triangle(triangles, number, middle, own[side], following, flipped)
                        number += 1
                middle += 1
            elif split >= WITHOUT_CORNER:
                after = split - WITHOUT_CORNER + 1
                set_triangle(triangles, number, own[after & 3], own[(after + 1) & 3], own[(after + 2) & 3], flipped)
                number += 1
            quad += 1
            left = left & (left - wp.uint64(1))


@wp.kernel
def _place_fans(
    first: int,
    grid: DualGrid,
    corners: wp.array(dtype=wp.vec4i),
    splits: wp.array(dtype=wp.uint8),
    starts: wp.array(dtype=wp.vec2i),
    blocks: wp.array(dtype=wp.vec3i),
    voxel_size: float,
    along: wp.array(dtype=float),
    cells: VertexArrays,
    fans: VertexArrays,
) -> None:
    layer = wp.tid() + first
    fan = starts[layer][1]
    if fan == starts[layer + 1][1]:
        return
    quad = grid.quad_starts[layer]
    block = blocks[number_of(grid.cells, layer >> 3)]
    for axis in range(3):
        left = complete_along(grid, layer, axis)
        while left != NONE:
            if int(splits[quad]) == FAN:
                bit = lowest_bit(left)
                corner = 8 * block + wp.vec3i(bit & 7, bit >> 3, layer & 7)
                point = wp.vec3(float(corner[0]), float(corner[1]), float(corner[2]))
                point[axis] += along[vertex_number(grid.cells, layer, axis, bit)]
                set_vertex_between(fan, voxel_size * point, corners[quad], cells, fans)
                fan += 1
            quad += 1
            left = left & (left - wp.uint64(1))


@wp.kernel
def _count_triangles(
    first: int,
    grid: DualGrid,
    corners: wp.array(dtype=wp.vec4i),
    splits: wp.array(dtype=wp.uint8),
    starts: wp.array(dtype=wp.vec2i),
) -> None:
    layer = wp.tid() + first
    quad = grid.quad_starts[layer]
    counts = wp.vec2i()
    for axis in range(3):
        left = complete_along(grid, layer, axis)
        while left != NONE:
            split = int(splits[quad])
            if split < FAN:
                counts += wp.vec2i(2, 0)
            elif split == FAN:
                counts += wp.vec2i(0, 1)
                pins = pins_around(grid, layer >> 3, layer & 7, lowest_bit(left), axis)
                for side in range(4):
                    if pins[side] >= 0:
                        counts += wp.vec2i(2, 0)
                    elif corners[quad][side] != corners[quad][(side + 1) & 3]:
                        counts += wp.vec2i(1, 0)
            elif split >= WITHOUT_CORNER:
                counts += wp.vec2i(1, 0)
            quad += 1
            left = left & (left - wp.uint64(1))
    starts[layer] = counts


@dataclass(frozen=True, kw_only=True)
class Cuts:
    """How quads are cut.

    ``corners`` (quads,) numbers of vertices, ``splits`` (quads,) how they are cut (``quad_split``); ``starts`` (layers
    + 1,) how many triangles and fans there are in a layer.
    """

    corners: wp.array
    splits: wp.array
    starts: wp.array


def split_quads(grid: DualGrid, corners: wp.array, along: wp.array, places: wp.array) -> Cuts:
    """Choose how the quads between ``corners``, vertices that lie at ``places`` in their cells, are cut."""
    device, layers = places.device, len(grid.several)
    splits = wp.empty(len(corners), dtype=wp.uint8, device=device)
    starts = wp.zeros(layers + 1, dtype=wp.vec2i, device=device)
    launch_over_layers(
        _split_quads, dim=layers, inputs=[grid, along, places, corners], outputs=[splits, starts], device=device
    )
    return Cuts(corners=corners, splits=splits, starts=starts)


def count_anew(grid: DualGrid, corners: wp.array, splits: wp.array) -> Cuts:
    """Return quads of which some corners are the same, and that are cut anew."""
    layers = len(grid.several)
    starts = wp.zeros(layers + 1, dtype=wp.vec2i, device=corners.device)
    inputs = [grid, corners, splits]
    launch_over_layers(_count_triangles, dim=layers, inputs=inputs, outputs=[starts], device=corners.device)
    return Cuts(corners=corners, splits=splits, starts=starts)


@dataclass(frozen=True, kw_only=True)
class CutQuads:
    """Quads cut into ``triangles`` (m, 3), of vertices numbered cells' first, then pins, then those of the ``fans``."""

    triangles: wp.array
    fans: Vertices


def cut_quads(
    volume: Volume,
    grid: DualGrid,
    cuts: Cuts,
    along: wp.array,
    cells: Vertices,
    *,
    pins: int,
    more: int,
    room: VertexRoom,
) -> CutQuads:
    """Cut quads between the ``cells``' vertices.

    ``pins`` is how many vertices on faces there are; there is room for ``more`` triangles behind those of the quads.
    The fans' vertices are in ``room``.
    """
    device, layers = volume.device, len(grid.several)
    # By layer how many triangles and fans come before.
    starts = cuts.starts
    sum_before(starts)
    triangle_total, fan_total = (int(total) for total in starts[layers:].numpy()[0])
    triangles = wp.empty((triangle_total + more, 3), dtype=int, device=device)
    quads = [grid, cuts.corners, cuts.splits, starts]
    launch_over_layers(
        _emit_triangles,
        dim=layers,
        inputs=[*quads, len(cells.points), len(cells.points) + pins],
        outputs=[triangles],
        device=device,
    )
    fans = room.take(fan_total)
    launch_in_slabs(
        _place_fans,
        dim=layers if fan_total else 0,
        inputs=[*quads, volume.table.blocks, volume.voxel_size, along, cells.arrays()],
        outputs=[fans.arrays()],
        device=device,
        least_slab=4096,
    )
    return CutQuads(triangles=triangles, fans=fans)
