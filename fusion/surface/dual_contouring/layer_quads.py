"""The C++ that decides how the quads of a layer are cut, several at a time."""

import warp as wp

from fusion.surface.dual_contouring.dual_grid import DualGrid
from fusion.surface.dual_contouring.lanes import LANES_IN_CPP
from fusion.surface.dual_contouring.quad_split import SPLIT_IN_CPP

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_SPLIT_LAYER_IN_CPP = (
    LANES_IN_CPP
    + "const float inset = grid.inset;"
    + SPLIT_IN_CPP
    + """
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
    #pragma unroll
    for (int axis = 0; axis < 3; ++axis) {
        const int second = axis == 2 ? 0 : axis + 1, third = axis == 0 ? 2 : axis - 1;
        const auto &complete = axis == 0 ? grid.complete_x : axis == 1 ? grid.complete_y : grid.complete_z;
        for (wp::uint64 left = complete.data[layer]; left != 0; left &= left - 1) {
            const int bit = wp::bit_count((left - 1) & ~left);
            #pragma unroll
            for (int corner = 0; corner < 4; ++corner) {
                // Corners 1 and 2 are one back along the second axis, 2 and 3 along the third.
                const wp::vec3 &place = places.data[corners.data[quad + filled][corner]];
                lanes_of(around[corner].x)[filled] = place[second] - (corner == 1 || corner == 2);
                lanes_of(around[corner].y)[filled] = place[third] - (corner >> 1);
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


@wp.func_native(_SPLIT_LAYER_IN_CPP)
def split_layer(
    grid: DualGrid,
    slot: int,
    z: int,
    along: wp.array(dtype=float),
    places: wp.array(dtype=wp.vec3),
    corners: wp.array(dtype=wp.vec4i),
    quad: int,
    splits: wp.array(dtype=wp.uint8),
) -> wp.vec2i:
    """Write how a layer's quads are cut, from number ``quad`` on, and return into how many triangles and fans."""
