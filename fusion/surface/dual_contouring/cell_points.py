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
from fusion.surface.dual_contouring.dual_grid import Counts, DualGrid, curve_number, place_of
from fusion.surface.dual_contouring.face_points import face_u, face_v
from fusion.surface.dual_contouring.qef import (
    INSET,
    Planes,
    kept_within,
    nearest_to_planes,
    with_plane,
)
from fusion.surface.layers import number_of, step_along, vertex_number, voxel_of
from fusion.volume.trilinear import Corners, gradient_of_terms, trilinear_terms
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxel_average import average_of
from fusion.volume.voxels import Voxels

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_NO_VERTEX = wp.constant(NO_VERTEX)
_LOWEST = wp.constant(INSET)
_HIGHEST = wp.constant(1.0 - INSET)
_SMALLEST_CROSS = wp.constant(1.0e-8)

Axes: Any = wp.types.vector(length=8, dtype=float)


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


@wp.struct
class CellCorners:
    """What the corners of a cell hold: average distances, colours, and 1 where a corner has a colour, else 0."""

    distances: Corners
    red: Corners
    green: Corners
    blue: Corners
    colored: Corners


@wp.func
def corners_of(voxels: Voxels, grid: DualGrid, slot: int, cell: wp.vec3i) -> CellCorners:
    """Return what the corners of a cell hold."""
    corners = CellCorners()
    for corner in range(8):
        x = cell[0] + (corner & 1)
        y = cell[1] + ((corner >> 1) & 1)
        z = cell[2] + (corner >> 2)
        average = average_of(voxels, voxel_of(grid.cells, slot, x, y, z))
        corners.distances[corner] = average[0]
        corners.red[corner] = average[1]
        corners.green[corner] = average[2]
        corners.blue[corner] = average[3]
        corners.colored[corner] = wp.where(average[4] > 0.0, 1.0, 0.0)
    return corners


@wp.func
def case_of_corners(corners: CellCorners) -> int:
    """Return a cell's sign pattern."""
    case = int(0)
    for corner in range(8):
        if corners.distances[corner] < 0.0:
            case |= 1 << corner
    return case


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
def color_at(corners: CellCorners, edge: int, along: float) -> wp.vec4:
    """Return the colour along an edge between corners that have one, and 1; 0 where neither has."""
    low = low_corner(edge)
    high = low + (1 << (edge >> 2))
    share_low = (1.0 - along) * corners.colored[low]
    share_high = along * corners.colored[high]
    share = share_low + share_high
    if share == 0.0:
        return wp.vec4()
    return wp.vec4(
        (share_low * corners.red[low] + share_high * corners.red[high]) / share,
        (share_low * corners.green[low] + share_high * corners.green[high]) / share,
        (share_low * corners.blue[low] + share_high * corners.blue[high]) / share,
        1.0,
    )


@wp.func
def as_bytes(sum: wp.vec4) -> wp.vec3ub:  # noqa: A002
    """Return the average of a sum of colours and their count; black where there are none."""
    scale = 1.0 / wp.max(sum[3], 1.0)
    return wp.vec3ub(
        wp.uint8(scale * sum[0] + 0.5), wp.uint8(scale * sum[1] + 0.5), wp.uint8(scale * sum[2] + 0.5)
    )


@wp.func
def set_vertices(
    grid: DualGrid,
    tables: CellTables,
    cell: int,
    corner: wp.vec3i,
    case: int,
    loop: int,
    planes: Planes,
    color: wp.vec4,
    voxel_size: float,
    places: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
    colors: wp.array(dtype=wp.vec3ub),
    normals: wp.array(dtype=wp.vec3),
) -> None:
    """Write the vertices of a loop: one, but for cells at the border of what was observed."""
    place = planes.points / planes.count
    if tables.loop_counts[case] == 1:
        place = nearest_to_planes(planes)
    place = kept_within(place)
    normal = wp.normalize(planes.normals)
    written = int(-1)
    for i in range(tables.ends[case, loop], tables.ends[case, loop + 1]):
        own = int((grid.codes[cell] >> wp.uint64(4 * tables.edges[case, i])) & wp.uint64(15))
        if own != _NO_VERTEX and own != written:
            vertex = grid.vertex_starts[cell] + own
            places[vertex] = place
            points[vertex] = voxel_size * (wp.vec3(float(corner[0]), float(corner[1]), float(corner[2])) + place)
            colors[vertex] = as_bytes(color)
            normals[vertex] = normal
            written = own


@wp.kernel
def _solve_cells(
    first: int,
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
    cell = wp.tid() + first
    at = grid.cell_at[cell]
    slot = at >> 9
    local = wp.vec3i(at & 7, (at >> 3) & 7, (at >> 6) & 7)
    corners = corners_of(voxels, grid, slot, local)
    terms = trilinear_terms(corners.distances)
    case = case_of_corners(corners)
    corner = 8 * blocks[number_of(grid.cells, slot)] + local
    for loop in range(tables.loop_counts[case]):
        planes = Planes()
        color = wp.vec4()
        for i in range(tables.ends[case, loop], tables.ends[case, loop + 1]):
            edge = tables.edges[case, i]
            low = low_corner(edge)
            a = corners.distances[low]
            along = wp.clamp(a / (a - corners.distances[low + (1 << (edge >> 2))]), _LOWEST, _HIGHEST)
            point = point_along(edge, along)
            planes = with_plane(planes, point, gradient_of_terms(terms, point))
            color += color_at(corners, edge, along)
        set_vertices(
            grid, tables, cell, corner, case, loop, planes, color, voxel_size, places, points, colors, normals
        )


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
    corners = corners_of(voxels, grid, slot, local)
    case = case_of_corners(corners)
    corner = 8 * blocks[number_of(grid.cells, slot)] + local
    for loop in range(tables.loop_counts[case]):
        planes = Planes()
        color = wp.vec4()
        start = tables.ends[case, loop]
        end = tables.ends[case, loop + 1]
        arriving = tables.curves[case, end - 1]
        for i in range(start, end):
            edge = tables.edges[case, i]
            along = along_edges[edge_number_in_cell(grid, slot, local, edge)]
            point = point_along(edge, along)
            leaving = tables.curves[case, i]
            before = face_point_in_cell(grid, curve_points, slot, local, arriving, 1)
            after = face_point_in_cell(grid, curve_points, slot, local, leaving, 0)
            normal = wp.cross(before - point, after - point)
            if wp.length(normal) < _SMALLEST_CROSS:
                normal = wp.vec3()
            # From the inside end of the edge to the outside one.
            outwards = wp.where(((case >> low_corner(edge)) & 1) == 1, 1.0, -1.0)
            if normal[edge >> 2] * outwards < 0.0:
                normal = -normal
            planes = with_plane(planes, point, normal)
            color += color_at(corners, edge, along)
            arriving = leaving
        set_vertices(
            grid, tables, cell, corner, case, loop, planes, color, voxel_size, places, points, colors, normals
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
    if curve_points is not None:
        inputs += [along, curve_points]
    launch_in_slabs(
        _solve_cells if curve_points is None else _solve_cells_from_faces,
        dim=counts.cells,
        inputs=inputs,
        outputs=[places, vertices.points, vertices.colors, vertices.normals],
        device=device,
        least_slab=256,
    )
    return places, vertices
