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
from fusion.surface.dual_contouring.pins import as_bytes
from fusion.surface.dual_contouring.qef import LANES_IN_CPP
from fusion.surface.dual_contouring.quad_split import FAN, SPLIT_IN_CPP
from fusion.surface.layers import NONE, launch_over_layers, lowest_bit, number_of, step_along, vertex_number
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# In C++ for its local arrays: the active cells of the eight layers around the edges are looked up once for all of them.
_QUADS_IN_CPP = (
    LANES_IN_CPP
    + SPLIT_IN_CPP
    + """
    struct { wp::uint64 active; int first; } owners[8];
    for (int back = 0; back < 8; ++back) {
        const int holder = grid.cells.lower.data[8 * slot + ((back & 3) | (z == 0 ? back & 4 : 0))];
        const int layer = 8 * holder + ((z - (back >> 2)) & 7);
        owners[back].active = holder < 0 ? 0 : grid.cells.active.data[layer];
        owners[back].first = holder < 0 ? 0 : grid.cells.starts.data[layer].c[1];
    }
    const int layer = 8 * slot + z;
    const wp::uint64 *edges = grid.cells.edges.data + 3 * (size_t)layer;
    int first_edge = grid.cells.starts.data[layer].c[0], triangles = 0, fans = 0, filled = 0;
    Point around[4] = {};
    V crossed_at = 0.0f;
    auto split_lanes = [&]() {
        const V chosen = choose_split(around, crossed_at);
        for (int lane = 0; lane < filled; ++lane) {
            const int split = (int)lanes_of(chosen)[lane];
            splits.data[quad + lane] = (unsigned char)split;
            triangles += split == FAN ? 4 : 2;
            fans += split == FAN;
        }
        quad += filled;
        filled = 0;
    };
    for (int axis = 0; axis < 3; ++axis) {
        const int second = axis == 2 ? 0 : axis + 1, third = axis == 0 ? 2 : axis - 1;
        const auto &complete = axis == 0 ? grid.complete_x : axis == 1 ? grid.complete_y : grid.complete_z;
        for (wp::uint64 left = complete.data[layer]; left != 0; left &= left - 1) {
            const int bit = wp::bit_count((left - 1) & ~left);
            for (int corner = 0; corner < 4; ++corner) {
                // Counter-clockwise about the edge: here, one back along the second axis, along both, along the third.
                const int back_second = corner == 1 || corner == 2, back_third = corner >> 1;
                const int back = back_second << second | back_third << third;
                const int x = (bit & 7) - (back & 1), y = (bit >> 3) - ((back >> 1) & 1);
                const auto &owner = owners[(x < 0) | (y < 0) << 1 | (back & 4)];
                const wp::uint64 before = ((wp::uint64)1 << (8 * (y & 7) + (x & 7))) - 1;
                const int cell = owner.first + wp::bit_count(owner.active & before);
                // Which of the cell's edges it is: of the other two axes the lower one counts 1, the higher one 2.
                const int edge = 4 * axis + (second < third ? back_second + 2 * back_third : back_third + 2 * back_second);
                const int own = (int)(grid.codes.data[cell] >> 4 * edge) & 15;
                const int vertex = grid.vertex_starts.data[cell] + own;
                const wp::vec3 place = places.data[vertex];
                corners.data[quad + filled][corner] = vertex;
                lanes_of(around[corner].x)[filled] = place[second] - back_second;
                lanes_of(around[corner].y)[filled] = place[third] - back_third;
                lanes_of(around[corner].z)[filled] = place[axis];
            }
            const wp::uint64 before = ((wp::uint64)1 << bit) - 1;
            lanes_of(crossed_at)[filled++] = along.data[first_edge + wp::bit_count(edges[axis] & before)];
            if (filled == LANES) split_lanes();
        }
        first_edge += wp::bit_count(edges[axis]);
    }
    if (filled > 0) split_lanes();
    return wp::vec2i(triangles, fans);
"""
)


@wp.func_native(_QUADS_IN_CPP)
def make_quads(
    grid: DualGrid,
    slot: int,
    z: int,
    along: wp.array(dtype=float),
    places: wp.array(dtype=wp.vec3),
    quad: int,
    corners: wp.array(dtype=wp.vec4i),
    splits: wp.array(dtype=wp.uint8),
) -> wp.vec2i:
    """Write a layer's quads from number ``quad`` on, and return how many triangles and fans they are cut into."""


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


@wp.func
def pins_around(grid: DualGrid, slot: int, z: int, bit: int, axis: int) -> wp.vec4i:
    """Return the numbers of the vertices on the faces between a quad's corner and the next, −1 for none."""
    voxel = wp.vec3i(bit & 7, bit >> 3, z)
    second = (axis + 1) % 3
    third = (axis + 2) % 3
    return wp.vec4i(
        pin_beside(grid, slot, voxel, axis, second, 0),
        pin_beside(grid, slot, voxel - step_along(second), axis, third, 1),
        pin_beside(grid, slot, voxel - step_along(third), axis, second, 1),
        pin_beside(grid, slot, voxel, axis, third, 0),
    )


@wp.func
def has_pins(grid: DualGrid, slot: int, z: int) -> bool:
    """Return whether a layer's quads may pass a vertex on a face."""
    for back in range(8):
        holder = grid.cells.lower[slot, (back & 3) | wp.where(z == 0, back & 4, 0)]
        if holder >= 0:
            layer = 8 * holder + ((z - (back >> 2)) & 7)
            if grid.curve_starts[layer][1] != grid.curve_starts[layer + 1][1]:
                return True
    return False


@wp.func
def complete_along(grid: DualGrid, layer: int, axis: int) -> wp.uint64:
    """Return the voxels of a layer whose edge along an axis is complete."""
    if axis == 0:
        return grid.complete_x[layer]
    if axis == 1:
        return grid.complete_y[layer]
    return grid.complete_z[layer]


@wp.kernel
def _make_quads(
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
    counts = make_quads(grid, slot, z, along, places, quad, corners, splits)
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
            if split == FAN:
                pins = pins_around(grid, layer >> 3, layer & 7, bit, axis)
                for side in range(4):
                    following = own[(side + 1) & 3]
                    if pins[side] >= 0:
                        pin = first_pin + pins[side]
                        set_triangle(triangles, number, middle, own[side], pin, flipped)
                        set_triangle(triangles, number + 1, middle, pin, following, flipped)
                        number += 2
                    else:
                        set_triangle(triangles, number, middle, own[side], following, flipped)
                        number += 1
                middle += 1
            else:
                a = own[split]
                c = own[split + 2]
                set_triangle(triangles, number, a, own[split + 1], c, flipped)
                set_triangle(triangles, number + 1, a, c, own[(split + 3) & 3], flipped)
                number += 2
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
    cell_colors: wp.array(dtype=wp.vec3ub),
    cell_normals: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
    colors: wp.array(dtype=wp.vec3ub),
    normals: wp.array(dtype=wp.vec3),
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
                color = wp.vec4()
                normal = wp.vec3()
                for i in range(4):
                    vertex = corners[quad][i]
                    own = cell_colors[vertex]
                    color += wp.vec4(float(own[0]), float(own[1]), float(own[2]), 1.0)
                    normal += cell_normals[vertex]
                points[fan] = voxel_size * point
                colors[fan] = as_bytes(color)
                normals[fan] = wp.normalize(normal)
                fan += 1
            quad += 1
            left = left & (left - wp.uint64(1))


@dataclass(frozen=True, kw_only=True)
class CutQuads:
    """Quads cut into ``triangles`` (m, 3), of vertices numbered cells' first, then pins, then those of the ``fans``."""

    triangles: wp.array
    fans: Vertices


def cut_quads(
    volume: Volume, grid: DualGrid, counts: Counts, along: wp.array, places: wp.array, cells: Vertices
) -> CutQuads:
    """Make the quads of the ``cells``' vertices, which lie at ``places`` in their cells, and cut them."""
    device, layers = volume.device, len(grid.cells.starts) - 1
    # By quad its corners and how it is cut; by layer how many triangles and fans come before.
    corners = wp.empty(counts.quads, dtype=wp.vec4i, device=device)
    splits = wp.empty(counts.quads, dtype=wp.uint8, device=device)
    starts = wp.zeros(layers + 1, dtype=wp.vec2i, device=device)
    launch_over_layers(
        _make_quads, dim=layers, inputs=[grid, along, places], outputs=[corners, splits, starts], device=device
    )
    array_scan(starts, starts, inclusive=False)
    triangle_total, fan_total = (int(total) for total in starts[layers:].numpy()[0])
    triangles = wp.empty((triangle_total, 3), dtype=int, device=device)
    quads = [grid, corners, splits, starts]
    launch_over_layers(
        _emit_triangles,
        dim=layers,
        inputs=[*quads, counts.vertices, counts.vertices + counts.pins],
        outputs=[triangles],
        device=device,
    )
    fans = Vertices.empty(fan_total, device)
    launch_in_slabs(
        _place_fans,
        dim=layers if fan_total else 0,
        inputs=[*quads, volume.table.blocks, volume.voxel_size, along, cells.colors, cells.normals],
        outputs=[fans.points, fans.colors, fans.normals],
        device=device,
        least_slab=4096,
    )
    return CutQuads(triangles=triangles, fans=fans)
