"""The C++ that solves the cells of a layer by the trilinear field, several at a time."""

import warp as wp

from fusion.surface.dual_contouring.cell_solver import CORNERS_IN_CPP, SOLVE_IN_CPP, TRILINEAR_IN_CPP
from fusion.surface.dual_contouring.cell_table import CellTables
from fusion.surface.dual_contouring.dual_grid import DualGrid
from fusion.surface.dual_contouring.lanes import LANES_IN_CPP
from fusion.surface.dual_contouring.qef import INSET, QEF_IN_CPP
from fusion.surface.dual_contouring.rows import ROWS_IN_CPP
from fusion.volume.voxels import Voxels

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

FLAT = 0.97
"""The mean squared cosine of a cell's normals to their mean from which on they face one way: 10° around it."""

# Most cells have one loop. Their corners are gathered cell by cell; then all lanes go through all twelve edges, those
# that are not crossed counting nothing, without a branch.
_GATHER_IN_CPP = """
    const bool packed = voxels.packed.shape[0] > 0;
    V distance[8], red[8], green[8], blue[8], colored[8];
    L held[8];
    auto gather = [&](int lane, int bit) {
        const int x = bit & 7, y = bit >> 3;
        size_t voxel[8];
        for (int corner = 0; corner < 8; ++corner)
            voxel[corner] = rows[corner & 4] + bit + (corner & 1) + 4 * (corner & 2);
        if (x == 7 || y == 7)
            for (int corner = 1; corner < 8; ++corner) {
                const int cx = x + (corner & 1), cy = y + ((corner >> 1) & 1);
                voxel[corner] = rows[(cx >> 3) | ((cy >> 3) << 1) | (corner & 4)] + 8 * (cy & 7) + (cx & 7);
            }
        for (int corner = 0; corner < 8; ++corner) {
            const size_t at = voxel[corner];
            if (packed) {
                lanes_of(held[corner])[lane] = voxels.packed.data[at];
            } else {
                const float weight = voxels.color_weight.data[at], inverse = weight > 0.0f ? 1.0f / weight : 0.0f;
                lanes_of(distance[corner])[lane] = voxels.distance_sum.data[at] / voxels.weight.data[at];
                lanes_of(red[corner])[lane] = inverse * voxels.color_sum.data[at].c[0];
                lanes_of(green[corner])[lane] = inverse * voxels.color_sum.data[at].c[1];
                lanes_of(blue[corner])[lane] = inverse * voxels.color_sum.data[at].c[2];
                lanes_of(colored[corner])[lane] = weight > 0.0f ? 1.0f : 0.0f;
            }
        }
    };
    auto unpack = [&]() {
        const V none = 0.0f, one = 1.0f;
        for (int corner = 0; corner < 8; ++corner) {
            const I low = to_ints(held[corner]), high = to_ints(held[corner] >> 32);
            distance[corner] = to_floats((low << 16) >> 16) * (1.0f / 32767.0f);
            red[corner] = to_floats(high & 255);
            green[corner] = to_floats((high >> 8) & 255);
            blue[corner] = to_floats((high >> 16) & 255);
            colored[corner] = to_floats((high >> 24) & 255) > none ? one : none;
        }
    };
"""

_ONTO_FIELD_IN_CPP = (
    f"constexpr float FLAT = {FLAT}f, LOW = {INSET}f, HIGH = 1.0f - {INSET}f;"
    + """
    // Where a cell's planes face one way the surface is smooth, and how the planes bulge over it is not its shape: one
    // step along the gradient leads back to where the trilinear field vanishes.
    auto onto_field = [&](const Planes &all, V size, V *place) {
        const V none = 0.0f, *n = all.normal;
        const V along = n[0] * (all.xx * n[0] + 2.0f * (all.xy * n[1] + all.xz * n[2]))
                        + n[1] * (all.yy * n[1] + 2.0f * all.yz * n[2]) + n[2] * all.zz * n[2];
        auto between = [](V a, V b, V t) { return a + t * (b - a); };
        V x[4], y[4];
        for (int i = 0; i < 4; ++i) x[i] = between(distance[2 * i], distance[2 * i + 1], place[0]);
        for (int i = 0; i < 2; ++i) y[i] = between(x[2 * i], x[2 * i + 1], place[1]);
        const V value = between(y[0], y[1], place[2]);
        const V rise_y = between(x[1] - x[0], x[3] - x[2], place[2]), rise_z = y[1] - y[0];
        const V low_x = between(distance[1] - distance[0], distance[3] - distance[2], place[1]);
        const V high_x = between(distance[5] - distance[4], distance[7] - distance[6], place[1]);
        const V rise_x = between(low_x, high_x, place[2]);
        const V steep = rise_x * rise_x + rise_y * rise_y + rise_z * rise_z;
        const auto moves = (along > FLAT * all.planes * size) & (steep > none);
        const V step = moves ? value / (moves ? steep : (V)1.0f) : none;
        const V rise[3] = {rise_x, rise_y, rise_z};
        for (int i = 0; i < 3; ++i) {
            const V moved = place[i] - step * rise[i];
            place[i] = moved < LOW ? (V)LOW : moved > HIGH ? (V)HIGH : moved;
        }
    };
"""
)

_SOLVE_LANES_IN_CPP = """
    int filled = 0, bits[LANES], numbers[LANES];
    auto solve_lanes = [&]() {
        const V none = 0.0f, one = 1.0f;
        if (packed) unpack();
        // How much the field rises along each edge, 4·axis + a number made of the corner's other two coordinates.
        auto low_of = [](int edge) {
            const int i = edge & 3;
            return edge < 4 ? i << 1 : edge < 8 ? (i & 1) | ((i & 2) << 1) : i;
        };
        auto edge_at = [](int axis, int corner) {
            const int x = corner & 1, y = (corner >> 1) & 1, z = corner >> 2;
            return 4 * axis + (axis == 0 ? y + 2 * z : axis == 1 ? x + 2 * z : x + 2 * y);
        };
        V rise[12];
        #pragma unroll
        for (int edge = 0; edge < 12; ++edge)
            rise[edge] = distance[low_of(edge) + (1 << (edge >> 2))] - distance[low_of(edge)];
        Planes all;
        V shares[8];
        for (int corner = 0; corner < 8; ++corner) shares[corner] = none;
        V edges_with_color = none;
        #pragma unroll
        for (int edge = 0; edge < 12; ++edge) {
            const int axis = edge >> 2, low = low_of(edge), high = low + (1 << axis);
            const V on = (distance[low] < none) != (distance[high] < none) ? one : none;
            V along = distance[low] / (on > none ? -rise[edge] : one);
            along = along < LOWEST ? (V)LOWEST : along > HIGHEST ? (V)HIGHEST : along;
            // The trilinear field's gradient: along the other axes it rises as along the edges at both ends.
            V gradient[3];
            for (int i = 0; i < 3; ++i) {
                const V at_low = rise[edge_at(i, low)], at_high = rise[edge_at(i, high)];
                gradient[i] = i == axis ? rise[edge] : at_low + along * (at_high - at_low);
            }
            add_plane(all, on, axis, low, along, gradient);
            // Between the edge's ends, one without colour left out.
            const V share_low = (one - along) * colored[low], share_high = along * colored[high];
            const V share = share_low + share_high, some = share > none ? on : none;
            const V part = some / (share > none ? share : one);
            shares[low] += part * share_low;
            shares[high] += part * share_high;
            edges_with_color += some;
        }
        V color[3] = {none, none, none}, place[3];
        for (int corner = 0; corner < 8; ++corner) {
            color[0] += shares[corner] * red[corner];
            color[1] += shares[corner] * green[corner];
            color[2] += shares[corner] * blue[corner];
        }
        const V scale = one / (edges_with_color > none ? edges_with_color : one);
        for (int channel = 0; channel < 3; ++channel) color[channel] = scale * color[channel] + 0.5f;
        V *n = all.normal;
        const V size = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
        const Equations equations = equations_of(all);
        solve(equations, place);
        for (int lane = 0; lane < filled; ++lane) {
            float at[3];
            for (int i = 0; i < 3; ++i) at[i] = lanes_of(place[i])[lane];
            keep_within_cell(equations, lane, at);
            for (int i = 0; i < 3; ++i) lanes_of(place[i])[lane] = at[i];
        }
        onto_field(all, size, place);
        for (int lane = 0; lane < filled; ++lane) {
            float at[3], normal[3];
            const float length = sqrtf(lanes_of(size)[lane]), inverse = length > 0.0f ? 1.0f / length : 0.0f;
            for (int i = 0; i < 3; ++i) at[i] = lanes_of(place[i])[lane], normal[i] = inverse * lanes_of(n[i])[lane];
            const float x = block_x + (bits[lane] & 7), y = block_y + (bits[lane] >> 3), z = block_z;
            // One vertex, but at the border of what was observed one for each arc of the loop.
            const int end = grid.vertex_starts.data[numbers[lane] + 1];
            for (int vertex = grid.vertex_starts.data[numbers[lane]]; vertex < end; ++vertex) {
                places.data[vertex] = wp::vec3(at[0], at[1], at[2]);
                points.data[vertex] = wp::vec3(voxel_size * (x + at[0]), voxel_size * (y + at[1]),
                                               voxel_size * (z + at[2]));
                normals.data[vertex] = wp::vec3(normal[0], normal[1], normal[2]);
                for (int channel = 0; channel < 3; ++channel)
                    colors.data[vertex].c[channel] = (unsigned char)lanes_of(color[channel])[lane];
            }
        }
        filled = 0;
    };
"""

_SOLVE_SEVERAL_LOOPS_IN_CPP = (
    "auto solve_several_loops = [&](int cell, int x, int y) {\n"
    f"const auto corners = [&]() {{ {CORNERS_IN_CPP} }}();\n"
    f"const auto planes = [&]() {{ {TRILINEAR_IN_CPP} }}();\n"
    """
        int pattern = 0;
        for (int corner = 0; corner < 8; ++corner) pattern |= corners.data[corner][0] < 0.0f ? 1 << corner : 0;
    """
    f"[&](float x, float y, float z) {{ {SOLVE_IN_CPP} }}(block_x + x, block_y + y, block_z);\n"
    "};\n"
)

# A layer's cells in one piece: Warp hands structs over by value, which for each cell would cost as much as solving it.
_SOLVE_LAYER_IN_CPP = (
    _SOLVE_SEVERAL_LOOPS_IN_CPP
    + LANES_IN_CPP
    + QEF_IN_CPP
    + "const auto &cells = grid.cells;"
    + ROWS_IN_CPP
    + _GATHER_IN_CPP
    + _ONTO_FIELD_IN_CPP
    + _SOLVE_LANES_IN_CPP
    + """
    const wp::uint64 several = grid.several.data[8 * slot + z];
    for (wp::uint64 left = active; left != 0; left &= left - 1, ++cell) {
        const int bit = wp::bit_count((left - 1) & ~left);
        if ((several >> bit) & 1) {
            solve_several_loops(cell, bit & 7, bit >> 3);
            continue;
        }
        gather(filled, bit);
        bits[filled] = bit;
        numbers[filled++] = cell;
        if (filled == LANES) solve_lanes();
    }
    if (filled > 0) {
        for (int lane = filled; lane < LANES; ++lane) gather(lane, bits[0]);  // numbers that do no harm
        solve_lanes();
    }
"""
)


@wp.func_native(_SOLVE_LAYER_IN_CPP)
def solve_layer(
    grid: DualGrid,
    tables: CellTables,
    slot: int,
    z: int,
    active: wp.uint64,
    cell: int,
    block_x: float,
    block_y: float,
    block_z: float,
    voxels: Voxels,
    voxel_size: float,
    places: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
    colors: wp.array(dtype=wp.vec3ub),
    normals: wp.array(dtype=wp.vec3),
) -> None:
    """Write the vertices of the ``active`` cells of a layer, from number ``cell`` on.

    The layer begins at ``block_x`` … on the lattice. Where the trilinear field crosses a cell's edges, its gradient is
    the surface's normal.
    """
