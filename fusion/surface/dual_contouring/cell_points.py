"""3-D points: the vertices within cells, where the planes through the cell's 1-D points meet.

A plane's normal comes from the trilinear field, whose gradient is known in closed form, or, where an oracle was asked,
from the 2-D points of the two curves that meet in the 1-D point. In a cell with several loops each vertex is the
centroid of its loop, which lies within the loop's hull whatever the loop is.
"""

import warp as wp

from fusion.devices import launch_in_slabs
from fusion.surface.dual_contouring.cell_solver import EdgePlanes, corners_of, solve_loops
from fusion.surface.dual_contouring.cell_table import CellTables, cell_tables
from fusion.surface.dual_contouring.dual_grid import Counts, DualGrid, cell_number, curve_number, place_of
from fusion.surface.dual_contouring.faces import face_u, face_v
from fusion.surface.dual_contouring.layer_solver import solve_layer
from fusion.surface.dual_contouring.vertices import Vertices
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


@wp.func
def pattern_of_cell(grid: DualGrid, at: int) -> int:
    """Return the sign pattern of the cell at 64·layer + bit."""
    slot = at >> 9
    z = (at >> 6) & 7
    low = corners_on(grid.cells.inside, grid.cells.upper, slot, z)
    high = corners_on(grid.cells.inside, grid.cells.upper, slot, z + 1)
    return case_of(low, high, at & 63)


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
        float(corner[2] + (layer & 7)),
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
