"""3-D points where an oracle was asked: planes through 1-D points, spanned by the 2-D points beside them."""

import warp as wp

from fusion.surface.dual_contouring.cell_solver import EdgePlanes, corners_of, solve_loops
from fusion.surface.dual_contouring.cell_table import CellTables
from fusion.surface.dual_contouring.dual_grid import DualGrid, curve_number, first_vertex, place_of
from fusion.surface.dual_contouring.faces import face_u, face_v
from fusion.surface.layers import (
    NONE,
    case_of,
    corners_on,
    lowest_bit,
    number_of,
    share_of,
    step_along,
    vertex_number,
)
from fusion.volume.voxels import Voxels

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_SMALLEST_CROSS = wp.constant(1.0e-8)


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


@wp.func
def plane_at(edge: int, along: float, before: wp.vec3, after: wp.vec3, pattern: int) -> wp.vec4:
    """Return an edge's row of ``EdgePlanes``, from the points that curves lead to before it and after it."""
    point = point_along(edge, along)
    normal = wp.cross(before - point, after - point)
    if wp.length(normal) < _SMALLEST_CROSS:
        normal = wp.vec3()
    # From the inside end of the edge to the outside one.
    outwards = wp.where(((pattern >> low_corner(edge)) & 1) == 1, 1.0, -1.0)
    if normal[edge >> 2] * outwards < 0.0:
        normal = -normal
    return wp.vec4(along, normal[0], normal[1], normal[2])


@wp.func
def planes_of(
    grid: DualGrid,
    tables: CellTables,
    pattern: int,
    slot: int,
    cell: wp.vec3i,
    along_edges: wp.array(dtype=float),
    curve_points: wp.array(dtype=wp.vec4),
) -> EdgePlanes:
    """Return the planes of a cell's crossed edges."""
    planes = EdgePlanes()
    for loop in range(tables.loop_counts[pattern]):
        end = tables.ends[pattern, loop + 1]
        arriving = tables.curves[pattern, end - 1]
        for i in range(tables.ends[pattern, loop], end):
            edge = tables.edges[pattern, i]
            leaving = tables.curves[pattern, i]
            before = face_point_in_cell(grid, curve_points, slot, cell, arriving, 1)
            after = face_point_in_cell(grid, curve_points, slot, cell, leaving, 0)
            along = along_edges[edge_number_in_cell(grid, slot, cell, edge)]
            planes[edge] = plane_at(edge, along, before, after, pattern)
            arriving = leaving
    return planes


@wp.kernel
def solve_cells_from_faces(
    first: int,
    shares: int,
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
    """Write the vertices of the cells of one of a layer's shares."""
    index = wp.tid() + first
    layer = index / shares
    left = grid.cells.active[layer] & share_of(index - layer * shares, shares)
    if left == NONE:
        return
    slot = layer >> 3
    low = corners_on(grid.cells.inside, grid.cells.upper, slot, layer & 7)
    high = corners_on(grid.cells.inside, grid.cells.upper, slot, (layer & 7) + 1)
    block = blocks[number_of(grid.cells, slot)]
    while left != NONE:
        bit = lowest_bit(left)
        pattern = case_of(low, high, bit)
        cell = wp.vec3i(bit & 7, bit >> 3, layer & 7)
        corner = 8 * block + cell
        solve_loops(
            tables,
            grid.inset,
            first_vertex(grid, layer, bit),
            pattern,
            corners_of(voxels, grid, slot, cell[0], cell[1], cell[2]),
            planes_of(grid, tables, pattern, slot, cell, along_edges, curve_points),
            float(corner[0]),
            float(corner[1]),
            float(corner[2]),
            voxel_size,
            places,
            points,
            colors,
            normals,
        )
        left = left & (left - wp.uint64(1))
