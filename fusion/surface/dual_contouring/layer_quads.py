"""The C++ that finds the quads of a layer, and how each is cut, several at a time."""

import warp as wp

from fusion.surface.dual_contouring.dual_grid import DualGrid
from fusion.surface.dual_contouring.lanes import LANES_IN_CPP
from fusion.surface.dual_contouring.quad_split import SPLIT_IN_CPP

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
                const int low = second < third ? back_second : back_third;
                const int edge = 4 * axis + low + 2 * (back_second + back_third - low);
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
