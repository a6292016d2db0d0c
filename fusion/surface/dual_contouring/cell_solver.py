"""The C++ that solves cells: what their corners hold, where the trilinear field crosses their edges, their vertices."""

from typing import Any

import warp as wp

from fusion.surface.dual_contouring.cell_table import CellTables
from fusion.surface.dual_contouring.dual_grid import DualGrid
from fusion.surface.dual_contouring.lanes import ONE_LANE_IN_CPP
from fusion.surface.dual_contouring.qef import QEF_IN_CPP
from fusion.volume.voxels import Voxels

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

Corners: Any = wp.types.matrix(shape=(8, 5), dtype=float)
"""Of each corner of a cell the average distance, the average colour's RGB, and 1 where it has one, else 0."""

EdgePlanes: Any = wp.types.matrix(shape=(12, 4), dtype=float)
"""For each edge of a cell how far along it is crossed, in voxels, and a normal of the surface there, of any length."""


CORNERS_IN_CPP = """
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


@wp.func_native(CORNERS_IN_CPP)
def corners_of(voxels: Voxels, grid: DualGrid, slot: int, x: int, y: int, z: int) -> Corners:
    """Return what the corners of a cell hold; all were seen."""


# Terms of 1, x, y, xy, z, xz, yz, xyz, as in ``fusion.volume.trilinear``.
TRILINEAR_IN_CPP = """
    const float LOWEST = grid.inset, HIGHEST = 1.0f - grid.inset;
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


SOLVE_IN_CPP = (
    ONE_LANE_IN_CPP
    + QEF_IN_CPP
    + """
    const int *ends = tables.ends.data + 5 * pattern;
    const int *edges = tables.edges.data + 12 * pattern;
    const int loops = tables.loop_counts.data[pattern];
    const bool with_normals = normals.shape[0] > 0;
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
        const int vertex = first + loop;
        places.data[vertex] = wp::vec3(place[0], place[1], place[2]);
        points.data[vertex] = wp::vec3(voxel_size * (x + place[0]), voxel_size * (y + place[1]),
                                       voxel_size * (z + place[2]));
        if (with_normals) normals.data[vertex] = wp::vec3(inverse * n[0], inverse * n[1], inverse * n[2]);
        for (int channel = 0; channel < 3; ++channel)
            colors.data[vertex].c[channel] = (unsigned char)(scale * color[channel] + 0.5f);
    }
"""
)


@wp.func_native(SOLVE_IN_CPP)
def solve_loops(
    tables: CellTables,
    inset: float,
    first: int,
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
    """Write a cell's vertices, one a loop, from number ``first`` on; its lowest corner is (x, y, z) on the lattice.

    Normals are left out where there is no room for them.
    """
