"""The C++ that solves the cells of a layer by the trilinear field, several at a time."""

import warp as wp

from fusion.surface.dual_contouring.cell_solver import CORNERS_IN_CPP, SOLVE_IN_CPP, TRILINEAR_IN_CPP
from fusion.surface.dual_contouring.cell_table import COUNT_SHIFT, CellTables
from fusion.surface.dual_contouring.dual_grid import DualGrid
from fusion.surface.dual_contouring.lanes import LANES_IN_CPP
from fusion.surface.dual_contouring.rows import ROWS_IN_CPP
from fusion.volume.voxels import Voxels

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# Most cells have one loop. Their corners are gathered cell by cell; then all lanes go through all twelve edges, those
# that are not crossed counting nothing, without a branch.
_GATHER_IN_CPP = """
    const bool packed = voxels.packed.shape[0] > 0;
    V distance[8], red[8], green[8], blue[8], colored[8];
    I held[8], colors_held[8];  // the halves of packed voxels
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
                const wp::uint64 bits = voxels.packed.data[at];
                lanes_of(held[corner])[lane] = (int)(unsigned int)bits;
                lanes_of(colors_held[corner])[lane] = (int)(bits >> 32);
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
            const I high = colors_held[corner];
            distance[corner] = to_floats((held[corner] << 16) >> 16) * (1.0f / 32767.0f);
            red[corner] = to_floats(high & 255);
            green[corner] = to_floats((high >> 8) & 255);
            blue[corner] = to_floats((high >> 16) & 255);
            colored[corner] = to_floats((high >> 24) & 255) > none ? one : none;
        }
    };
"""

_CROSSINGS_IN_CPP = """
    auto low_of = [](int edge) {
        const int i = edge & 3;
        return edge < 4 ? i << 1 : edge < 8 ? (i & 1) | ((i & 2) << 1) : i;
    };
    // By edge how much the field rises along it, whether it is crossed (1 or 0) and where, in voxels; and the points'
    // centroid.
    V rise[12], on[12], along[12], centroid[3];
    auto find_crossings = [&]() {
        const V none = 0.0f, one = 1.0f;
        V count = none;
        for (int i = 0; i < 3; ++i) centroid[i] = none;
        #pragma unroll
        for (int edge = 0; edge < 12; ++edge) {
            const int axis = edge >> 2, low = low_of(edge), high = low + (1 << axis);
            rise[edge] = distance[high] - distance[low];
            on[edge] = (distance[low] < none) != (distance[high] < none) ? one : none;
            const V at = distance[low] / (on[edge] > none ? -rise[edge] : one);
            along[edge] = at < LOWEST ? (V)LOWEST : at > HIGHEST ? (V)HIGHEST : at;
            for (int i = 0; i < 3; ++i)
                if (i == axis) centroid[i] += on[edge] * along[edge];
                else if ((low >> i) & 1) centroid[i] += on[edge];
            count += on[edge];
        }
        const V share = one / count;
        for (int i = 0; i < 3; ++i) centroid[i] = share * centroid[i];
    };
"""

_COLORS_IN_CPP = """
    // The crossings' average colour, each between its edge's ends, one without colour left out.
    auto mix_colors = [&](V *color) {
        const V none = 0.0f, one = 1.0f;
        V shares[8], edges_with_color = none, least = one;
        for (int corner = 0; corner < 8; ++corner) {
            shares[corner] = none;
            least = colored[corner] < least ? colored[corner] : least;
        }
        bool all_colored = true;
        for (int lane = 0; lane < LANES; ++lane) all_colored &= lanes_of(least)[lane] > 0.0f;
        #pragma unroll
        for (int edge = 0; edge < 12; ++edge) {
            const int low = low_of(edge), high = low + (1 << (edge >> 2));
            V share_low = one - along[edge], share_high = along[edge], part = on[edge];
            if (!all_colored) {
                share_low *= colored[low];
                share_high *= colored[high];
                const V share = share_low + share_high;
                part = share > none ? part / (share > none ? share : one) : none;
                edges_with_color += share > none ? on[edge] : none;
            } else {
                edges_with_color += on[edge];
            }
            shares[low] += part * share_low;
            shares[high] += part * share_high;
        }
        const V scale = one / (edges_with_color > none ? edges_with_color : one);
        for (int channel = 0; channel < 3; ++channel) color[channel] = none;
        for (int corner = 0; corner < 8; ++corner) {
            color[0] += shares[corner] * red[corner];
            color[1] += shares[corner] * green[corner];
            color[2] += shares[corner] * blue[corner];
        }
        for (int channel = 0; channel < 3; ++channel) color[channel] = scale * color[channel] + 0.5f;
    };
"""

_SOLVE_LANES_IN_CPP = """
    auto solve_lanes = [&]() {
        if (packed) unpack();
        find_crossings();
        V color[3], normal[3], square = 0.0f;
        mix_colors(color);
        if (with_normals) for (int axis = 0; axis < 3; ++axis) {
            const V *r = rise + 4 * axis;
            normal[axis] = (r[0] + r[1]) + (r[2] + r[3]);
            square += normal[axis] * normal[axis];
        }
        for (int lane = 0; lane < filled; ++lane) {
            const float size = with_normals ? sqrtf(lanes_of(square)[lane]) : 0.0f;
            const float inverse = size > 0.0f ? 1.0f / size : 0.0f;
            const int vertex = numbers[lane];
            for (int i = 0; i < 3; ++i) {
                places.data[vertex][i] = lanes_of(centroid[i])[lane];
                if (with_normals) normals.data[vertex][i] = inverse * lanes_of(normal[i])[lane];
                colors.data[vertex].c[i] = (unsigned char)lanes_of(color[i])[lane];
            }
        }
        filled = 0;
    };
"""

_SOLVE_SEVERAL_LOOPS_IN_CPP = (
    "auto solve_several_loops = [&](int first, int x, int y) {\n"
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
    "const float inset = grid.inset;"
    + _SOLVE_SEVERAL_LOOPS_IN_CPP
    + LANES_IN_CPP
    + f"const float LOWEST = inset, HIGHEST = 1.0f - inset; constexpr int COUNT_SHIFT = {COUNT_SHIFT};"
    + "const auto &cells = grid.cells; const bool with_normals = normals.shape[0] > 0;"
    + ROWS_IN_CPP
    + "int filled = 0, bits[LANES], numbers[LANES];"
    + _GATHER_IN_CPP
    + _CROSSINGS_IN_CPP
    + _COLORS_IN_CPP
    + _SOLVE_LANES_IN_CPP
    + """
    const wp::uint64 several = grid.several.data[8 * slot + z];
    for (wp::uint64 left = active; left != 0; left &= left - 1) {
        const int bit = wp::bit_count((left - 1) & ~left);
        if ((several >> bit) & 1) {
            solve_several_loops(vertex, bit & 7, bit >> 3);
            vertex += (int)(grid.codes.data[several_cell++] >> COUNT_SHIFT);
        } else {
            gather(filled, bit);
            bits[filled] = bit;
            numbers[filled++] = vertex++;
            if (filled == LANES) solve_lanes();
        }
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
    vertex: int,
    several_cell: int,
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
    """Write the vertices of the ``active`` cells of a layer, from numbers ``vertex`` and ``several_cell`` on.

    The layer begins at ``block_x`` … on the lattice. A cell's only vertex begins at the centroid of its crossings, and
    its normal is the trilinear field's mean gradient; its point is written later (``close_gaps``). Normals are left out
    where there is no room for them.
    """
