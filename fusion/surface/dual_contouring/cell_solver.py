"""The C++ that solves cells: what their corners hold, where the trilinear field crosses their edges, their vertices."""

from typing import Any

import warp as wp

from fusion.surface.dual_contouring.cell_table import NO_VERTEX, CellTables
from fusion.surface.dual_contouring.dual_grid import DualGrid
from fusion.surface.dual_contouring.qef import INSET, LANES_IN_CPP, ONE_CELL_IN_CPP, QEF_IN_CPP
from fusion.volume.voxels import Voxels

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

Corners: Any = wp.types.matrix(shape=(8, 5), dtype=float)
"""Of each corner of a cell the average distance, the average colour's RGB, and 1 where it has one, else 0."""

EdgePlanes: Any = wp.types.matrix(shape=(12, 4), dtype=float)
"""For each edge of a cell how far along it is crossed, in voxels, and a normal of the surface there, of any length."""


_CORNERS_IN_CPP = """
    wp::mat_t<8, 5, float> corners;
    const bool packed = voxels.packed.shape[0] > 0;
    const bool numbered = grid.cells.numbers.shape[0] > 0;
    for (int corner = 0; corner < 8; ++corner) {
        const int cx = x + (corner & 1), cy = y + ((corner >> 1) & 1), cz = z + (corner >> 2);
        const int holder = grid.cells.upper.data[8 * slot + ((cx >> 3) | ((cy >> 3) << 1) | ((cz >> 3) << 2))];
        const int number = numbered ? grid.cells.numbers.data[holder] : holder;
        const size_t voxel = 512 * (size_t)number + (cz & 7) * 64 + (cy & 7) * 8 + (cx & 7);
        float *held = corners.data[corner];
        if (packed) {
            const wp::uint64 bits = voxels.packed.data[voxel];
            held[0] = (float)(short)(bits & 0xffff) * (1.0f / 32767.0f);
            for (int i = 0; i < 3; ++i) held[1 + i] = (float)((bits >> (32 + 8 * i)) & 255);
            held[4] = bits >> 56 ? 1.0f : 0.0f;
        } else {
            held[0] = voxels.distance_sum.data[voxel] / voxels.weight.data[voxel];
            const float color_weight = voxels.color_weight.data[voxel];
            const float inverse = color_weight > 0.0f ? 1.0f / color_weight : 0.0f;
            for (int i = 0; i < 3; ++i) held[1 + i] = inverse * voxels.color_sum.data[voxel].c[i];
            held[4] = color_weight > 0.0f ? 1.0f : 0.0f;
        }
    }
    return corners;
"""


@wp.func_native(_CORNERS_IN_CPP)
def corners_of(voxels: Voxels, grid: DualGrid, slot: int, x: int, y: int, z: int) -> Corners:
    """Return what the corners of a cell hold; all were seen."""


# Terms of 1, x, y, xy, z, xz, yz, xyz, as in ``fusion.volume.trilinear``.
_TRILINEAR_IN_CPP = (
    f"constexpr float LOWEST = {INSET}f, HIGHEST = 1.0f - {INSET}f;"
    + """
    wp::mat_t<12, 4, float> planes;
    float v[8], k[8];
    for (int i = 0; i < 8; ++i) v[i] = corners.data[i][0];
    k[1] = v[1] - v[0]; k[2] = v[2] - v[0]; k[4] = v[4] - v[0];
    k[3] = v[3] - v[2] - v[1] + v[0]; k[5] = v[5] - v[4] - v[1] + v[0]; k[6] = v[6] - v[4] - v[2] + v[0];
    k[7] = (v[7] - v[6] - v[5] + v[4]) - (v[3] - v[2] - v[1] + v[0]);
    for (int edge = 0; edge < 12; ++edge) {
        const int axis = edge >> 2, i = edge & 3;
        const int low = axis == 0 ? i << 1 : axis == 1 ? (i & 1) | ((i & 2) << 1) : i;
        const float a = v[low], b = v[low + (1 << axis)];
        if ((a < 0.0f) == (b < 0.0f)) continue;
        float along = a / (a - b);
        along = along < LOWEST ? LOWEST : along > HIGHEST ? HIGHEST : along;
        float p[3] = {(float)(low & 1), (float)((low >> 1) & 1), (float)(low >> 2)};
        p[axis] = along;
        planes.data[edge][0] = along;
        planes.data[edge][1] = k[1] + k[3] * p[1] + k[5] * p[2] + k[7] * p[1] * p[2];
        planes.data[edge][2] = k[2] + k[3] * p[0] + k[6] * p[2] + k[7] * p[0] * p[2];
        planes.data[edge][3] = k[4] + k[5] * p[0] + k[6] * p[1] + k[7] * p[0] * p[1];
    }
    return planes;
"""
)


_SOLVE_IN_CPP = (
    f"constexpr int NO_VERTEX = {NO_VERTEX};"
    + ONE_CELL_IN_CPP
    + QEF_IN_CPP
    + """
    const int *ends = tables.ends.data + 5 * pattern;
    const int *edges = tables.edges.data + 12 * pattern;
    const int loops = tables.loop_counts.data[pattern];
    const int first = grid.vertex_starts.data[cell];
    const wp::uint64 code = grid.codes.data[cell];
    for (int loop = 0; loop < loops; ++loop) {
        Planes all;
        float color[3] = {0.0f}, colored = 0.0f;
        for (int i = ends[loop]; i < ends[loop + 1]; ++i) {
            const int edge = edges[i], axis = edge >> 2, k = edge & 3;
            const int low = axis == 0 ? k << 1 : axis == 1 ? (k & 1) | ((k & 2) << 1) : k;
            const float *plane = planes.data[edge], along = plane[0];
            add_plane(all, 1.0f, axis, low, along, plane + 1);
            // Between the edge's ends, one without colour left out.
            const float *a = corners.data[low], *b = corners.data[low + (1 << axis)];
            const float share_a = (1.0f - along) * a[4], share_b = along * b[4], share = share_a + share_b;
            if (share > 0.0f) {
                const float part = 1.0f / share;
                for (int channel = 0; channel < 3; ++channel)
                    color[channel] += part * (share_a * a[1 + channel] + share_b * b[1 + channel]);
                colored += 1.0f;
            }
        }
        float place[3];
        if (loops == 1) {
            const Equations equations = equations_of(all);
            solve(equations, place);
            keep_within_cell(equations, 0, place);
        } else {
            for (int i = 0; i < 3; ++i) place[i] = within(all.points[i] / all.count);
        }
        const float *n = all.normal, size = sqrtf(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
        const float inverse = size > 0.0f ? 1.0f / size : 0.0f, scale = colored > 0.0f ? 1.0f / colored : 0.0f;
        int written = -1;
        // One vertex a loop, but for cells at the border of what was observed.
        for (int i = ends[loop]; i < ends[loop + 1]; ++i) {
            const int own = (int)(code >> 4 * edges[i]) & 15;
            if (own == NO_VERTEX || own == written) continue;
            written = own;
            const int vertex = first + own;
            places.data[vertex] = wp::vec3(place[0], place[1], place[2]);
            points.data[vertex] = wp::vec3(voxel_size * (x + place[0]), voxel_size * (y + place[1]),
                                           voxel_size * (z + place[2]));
            normals.data[vertex] = wp::vec3(inverse * n[0], inverse * n[1], inverse * n[2]);
            for (int channel = 0; channel < 3; ++channel)
                colors.data[vertex].c[channel] = (unsigned char)(scale * color[channel] + 0.5f);
        }
    }
"""
)


@wp.func_native(_SOLVE_IN_CPP)
def solve_loops(
    grid: DualGrid,
    tables: CellTables,
    cell: int,
    pattern: int,
    corners: Corners,
    planes: EdgePlanes,
    x: float,
    y: float,
    z: float,
    voxel_size: float,
    places: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
    colors: wp.array(dtype=wp.vec3ub),
    normals: wp.array(dtype=wp.vec3),
) -> None:
    """Write the vertices of a cell, whose lowest corner is (x, y, z) on the lattice."""


# Most cells have one loop. Their corners are gathered cell by cell; then all lanes go through all twelve edges, those
# that are not crossed counting nothing, without a branch.
_GATHER_IN_CPP = """
    // Where the layers of the blocks at the cells' corners begin.
    size_t rows[8];
    const bool numbered = grid.cells.numbers.shape[0] > 0;
    for (int corner = 0; corner < 8; ++corner) {
        const int holder = grid.cells.upper.data[8 * slot + ((corner & 3) | (z == 7 ? corner & 4 : 0))];
        const int number = holder < 0 || !numbered ? holder : grid.cells.numbers.data[holder];
        rows[corner] = 512 * (size_t)(number < 0 ? 0 : number) + 64 * ((z + (corner >> 2)) & 7);
    }
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

_SOLVE_LANES_IN_CPP = """
    int filled = 0, bits[LANES], cells[LANES];
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
            float at[3], normal[3];
            const float length = sqrtf(lanes_of(size)[lane]), inverse = length > 0.0f ? 1.0f / length : 0.0f;
            for (int i = 0; i < 3; ++i) at[i] = lanes_of(place[i])[lane], normal[i] = inverse * lanes_of(n[i])[lane];
            keep_within_cell(equations, lane, at);
            const float x = block_x + (bits[lane] & 7), y = block_y + (bits[lane] >> 3), z = block_z;
            // One vertex, but at the border of what was observed one for each arc of the loop.
            const int end = grid.vertex_starts.data[cells[lane] + 1];
            for (int vertex = grid.vertex_starts.data[cells[lane]]; vertex < end; ++vertex) {
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
    f"const auto corners = [&]() {{ {_CORNERS_IN_CPP} }}();\n"
    f"const auto planes = [&]() {{ {_TRILINEAR_IN_CPP} }}();\n"
    """
        int pattern = 0;
        for (int corner = 0; corner < 8; ++corner) pattern |= corners.data[corner][0] < 0.0f ? 1 << corner : 0;
    """
    f"[&](float x, float y, float z) {{ {_SOLVE_IN_CPP} }}(block_x + x, block_y + y, block_z);\n"
    "};\n"
)

# A layer's cells in one piece: Warp hands structs over by value, which for each cell would cost as much as solving it.
_SOLVE_LAYER_IN_CPP = (
    _SOLVE_SEVERAL_LOOPS_IN_CPP
    + LANES_IN_CPP
    + QEF_IN_CPP
    + _GATHER_IN_CPP
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
        cells[filled++] = cell;
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
