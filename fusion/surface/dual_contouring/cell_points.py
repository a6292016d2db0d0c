"""3-D points: the vertices within cells, where the planes through the cell's 1-D points meet.

A plane's normal comes from the trilinear field, whose gradient is known in closed form, or, where an oracle was asked,
from the 2-D points of the two curves that meet in the 1-D point. In a cell with several loops each vertex is the
centroid of its loop, which lies within the loop's hull whatever the loop is.
"""

from dataclasses import dataclass
from typing import Any

import warp as wp

from fusion.devices import launch_in_slabs
from fusion.surface.dual_contouring.cell_table import NO_VERTEX, CellTables, cell_tables
from fusion.surface.dual_contouring.dual_grid import Counts, DualGrid, cell_number, curve_number, place_of
from fusion.surface.dual_contouring.face_points import face_u, face_v
from fusion.surface.dual_contouring.qef import INSET, QEF_IN_CPP
from fusion.surface.layers import (
    NONE,
    case_of,
    corners_on,
    launch_over_layers,
    lowest_bit,
    number_of,
    share_of,
    shares_on,
    step_along,
    vertex_number,
)
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxels import Voxels

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_SMALLEST_CROSS = wp.constant(1.0e-8)

Corners: Any = wp.types.matrix(shape=(8, 5), dtype=float)
"""Of each corner of a cell the average distance, the average colour's RGB, and 1 where it has one, else 0."""

EdgePlanes: Any = wp.types.matrix(shape=(12, 4), dtype=float)
"""For each edge of a cell how far along it is crossed, in voxels, and a normal of the surface there, of any length."""


@dataclass(frozen=True, kw_only=True)
class Vertices:
    """Vertices on the device (n,): ``points`` metres in the world, ``colors`` RGB, unit ``normals``."""

    points: wp.array
    colors: wp.array
    normals: wp.array

    @staticmethod
    def empty(count: int, device: Any) -> "Vertices":
        """Return room for vertices."""
        return Vertices(
            points=wp.empty(count, dtype=wp.vec3, device=device),
            colors=wp.empty(count, dtype=wp.vec3ub, device=device),
            normals=wp.empty(count, dtype=wp.vec3, device=device),
        )


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
            float p[3] = {(float)(low & 1), (float)((low >> 1) & 1), (float)(low >> 2)};
            p[axis] = along;
            add_plane(all, p, plane[1], plane[2], plane[3]);
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
            nearest_to_planes(all, place);
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


@wp.func
def pattern_of_cell(grid: DualGrid, at: int) -> int:
    """Return the sign pattern of the cell at 64·layer + bit."""
    slot = at >> 9
    z = (at >> 6) & 7
    low = corners_on(grid.cells.inside, grid.cells.upper, slot, z)
    high = corners_on(grid.cells.inside, grid.cells.upper, slot, z + 1)
    return case_of(low, high, at & 63)


# A layer's cells in one piece: Warp hands structs over by value, which for each cell would cost as much as solving it.
_SOLVE_LAYER_IN_CPP = (
    """
    for (wp::uint64 left = active; left != 0; left &= left - 1, ++cell) {
        const int bit = wp::bit_count((left - 1) & ~left), x = bit & 7, y = bit >> 3;
    """
    f"const auto corners = [&]() {{ {_CORNERS_IN_CPP} }}();\n"
    f"const auto planes = [&]() {{ {_TRILINEAR_IN_CPP} }}();\n"
    """
        int pattern = 0;
        for (int corner = 0; corner < 8; ++corner) pattern |= corners.data[corner][0] < 0.0f ? 1 << corner : 0;
    """
    f"[&](float x, float y, float z) {{ {_SOLVE_IN_CPP} }}(block_x + x, block_y + y, block_z + z);\n"
    "}"
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

    The block's lowest corner is at ``block_x`` … on the lattice. Where the trilinear field crosses a cell's edges, its
    gradient is the surface's normal.
    """


@wp.kernel
def _solve_cells(
    first: int,
    shares: int,
    grid: DualGrid,
    tables: CellTables,
    blocks: wp.array(dtype=wp.vec3i),
    voxels: Voxels,
    voxel_size: float,
    places: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
    colors: wp.array(dtype=wp.vec3ub),
    normals: wp.array(dtype=wp.vec3),
) -> None:
    index = wp.tid() + first
    layer = index / shares
    share = share_of(index - layer * shares, shares)
    active = grid.cells.active[layer] & share
    if active == NONE:
        return
    slot = layer >> 3
    corner = 8 * blocks[number_of(grid.cells, slot)]
    solve_layer(
        grid,
        tables,
        slot,
        layer & 7,
        active,
        cell_number(grid, layer, lowest_bit(active)),
        float(corner[0]),
        float(corner[1]),
        float(corner[2]),
        voxels,
        voxel_size,
        places,
        points,
        colors,
        normals,
    )


@wp.func
def low_corner(edge: int) -> int:
    """Return the corner of a cell at which an edge begins."""
    k = edge & 3
    if edge < 4:
        return k << 1
    if edge < 8:
        return (k & 1) | ((k & 2) << 1)
    return k


@wp.func
def point_along(edge: int, along: float) -> wp.vec3:
    """Return a point of a cell's edge in the cell."""
    low = low_corner(edge)
    point = wp.vec3(float(low & 1), float((low >> 1) & 1), float(low >> 2))
    point[edge >> 2] = along
    return point


@wp.func
def edge_number_in_cell(grid: DualGrid, slot: int, cell: wp.vec3i, edge: int) -> int:
    """Return the number of the lattice edge that is a cell's edge."""
    low = low_corner(edge)
    place = place_of(grid.cells.upper, slot, cell[0] + (low & 1), cell[1] + ((low >> 1) & 1), cell[2] + (low >> 2))
    return vertex_number(grid.cells, place[0], edge >> 2, place[1])


@wp.func
def face_point_in_cell(
    grid: DualGrid, curve_points: wp.array(dtype=wp.vec4), slot: int, cell: wp.vec3i, curve: int, end: int
) -> wp.vec3:
    """Return where a curve on one of a cell's faces leads to from one of its ends, in the cell.

    ``curve`` is as in ``CellTable``; ``end`` is 0 where the loop comes from, 1 where it goes to.
    """
    axis = curve >> 3
    side = (curve >> 2) & 1
    voxel = cell + side * step_along(axis)
    place = place_of(grid.cells.upper, slot, voxel[0], voxel[1], voxel[2])
    leads = curve_points[curve_number(grid, place[0], axis, place[1]) + ((curve >> 1) & 1)]
    second = (curve & 1) != end
    point = wp.vec3()
    point[axis] = float(side)
    point[face_u(axis)] = wp.where(second, leads[2], leads[0])
    point[face_v(axis)] = wp.where(second, leads[3], leads[1])
    return point


@wp.kernel
def _solve_cells_from_faces(
    first: int,
    grid: DualGrid,
    tables: CellTables,
    blocks: wp.array(dtype=wp.vec3i),
    voxels: Voxels,
    voxel_size: float,
    along_edges: wp.array(dtype=float),
    curve_points: wp.array(dtype=wp.vec4),
    places: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
    colors: wp.array(dtype=wp.vec3ub),
    normals: wp.array(dtype=wp.vec3),
) -> None:
    cell = wp.tid() + first
    at = grid.cell_at[cell]
    slot = at >> 9
    local = wp.vec3i(at & 7, (at >> 3) & 7, (at >> 6) & 7)
    pattern = pattern_of_cell(grid, at)
    planes = EdgePlanes()
    for loop in range(tables.loop_counts[pattern]):
        start = tables.ends[pattern, loop]
        end = tables.ends[pattern, loop + 1]
        arriving = tables.curves[pattern, end - 1]
        for i in range(start, end):
            edge = tables.edges[pattern, i]
            leaving = tables.curves[pattern, i]
            along = along_edges[edge_number_in_cell(grid, slot, local, edge)]
            point = point_along(edge, along)
            before = face_point_in_cell(grid, curve_points, slot, local, arriving, 1)
            after = face_point_in_cell(grid, curve_points, slot, local, leaving, 0)
            normal = wp.cross(before - point, after - point)
            if wp.length(normal) < _SMALLEST_CROSS:
                normal = wp.vec3()
            # From the inside end of the edge to the outside one.
            outwards = wp.where(((pattern >> low_corner(edge)) & 1) == 1, 1.0, -1.0)
            if normal[edge >> 2] * outwards < 0.0:
                normal = -normal
            planes[edge, 0] = along
            planes[edge, 1] = normal[0]
            planes[edge, 2] = normal[1]
            planes[edge, 3] = normal[2]
            arriving = leaving
    corner = 8 * blocks[number_of(grid.cells, slot)] + local
    solve_loops(
        grid,
        tables,
        cell,
        pattern,
        corners_of(voxels, grid, slot, local[0], local[1], local[2]),
        planes,
        float(corner[0]),
        float(corner[1]),
        float(corner[2]),
        voxel_size,
        places,
        points,
        colors,
        normals,
    )


def cell_points(
    volume: Volume, grid: DualGrid, counts: Counts, along: wp.array, curve_points: wp.array | None
) -> tuple[wp.array, Vertices]:
    """Return the vertices within cells, and where in their cells they are (vertices,), in voxels.

    Their planes come from ``curve_points``, or without these from the trilinear field.
    """
    device = volume.device
    places = wp.empty(counts.vertices, dtype=wp.vec3, device=device)
    vertices = Vertices.empty(counts.vertices, device)
    tables = cell_tables(str(device.alias))
    inputs = [grid, tables, volume.table.blocks, volume.voxels, volume.voxel_size]
    outputs = [places, vertices.points, vertices.colors, vertices.normals]
    if curve_points is None:
        shares = shares_on(device)
        dim = shares * (len(grid.cells.starts) - 1)
        launch_over_layers(_solve_cells, dim=dim, inputs=[shares, *inputs], outputs=outputs, device=device)
    else:
        inputs += [along, curve_points]
        launch_in_slabs(
            _solve_cells_from_faces, dim=counts.cells, inputs=inputs, outputs=outputs, device=device, least_slab=256
        )
    return places, vertices
