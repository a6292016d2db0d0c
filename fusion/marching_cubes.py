"""Marching cubes on the sparse blocks, across their borders, with interpolated colours."""

import numpy as np
import warp as wp
from warp.utils import array_scan

from fusion.block_table import BLOCK_SIDE
from fusion.cells import CaseTables, classify_cells, voxel_index
from fusion.devices import launch_in_slabs
from fusion.marching_cubes_table import EDGE_CORNERS, triangle_table
from fusion.mesh import Mesh
from fusion.volume import Volume
from fusion.voxels import Voxels, sums_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_ROWS = wp.constant(BLOCK_SIDE * BLOCK_SIDE)


@wp.func
def vertex_number(
    row_vertices: wp.array(dtype=int), edge_used: wp.array2d(dtype=wp.uint8), voxel: int, axis: int
) -> int:
    """Return the number of the vertex on the edge from ``voxel`` along ``axis``: those before it in its row count."""
    row = voxel >> 3
    number = row_vertices[row]
    for before in range(8 * row, voxel):
        number += int(edge_used[0, before]) + int(edge_used[1, before]) + int(edge_used[2, before])
    for before_axis in range(axis):
        number += int(edge_used[before_axis, voxel])
    return number


@wp.kernel
def _emit_vertices(
    first: int,
    blocks: wp.array(dtype=wp.vec3i),
    neighbours: wp.array2d(dtype=int),
    edge_used: wp.array2d(dtype=wp.uint8),
    row_vertices: wp.array(dtype=int),
    voxels: Voxels,
    voxel_size: float,
    vertices: wp.array(dtype=wp.vec3),
    colors: wp.array(dtype=wp.vec3),
) -> None:
    row = wp.tid() + first
    number = row / _ROWS
    y = row & 7
    z = (row >> 3) & 7
    block = blocks[number]
    vertex = row_vertices[row]
    for x in range(8):
        voxel = 8 * row + x
        for axis in range(3):
            if edge_used[axis, voxel] != wp.uint8(0):
                step = wp.vec3i(wp.where(axis == 0, 1, 0), wp.where(axis == 1, 1, 0), wp.where(axis == 2, 1, 0))
                other = voxel_index(neighbours, number, x + step[0], y + step[1], z + step[2])
                sums_a = sums_of(voxels, voxel)
                sums_b = sums_of(voxels, other)
                a = sums_a.distance / sums_a.weight
                b = sums_b.distance / sums_b.weight
                along = a / (a - b)
                start = wp.vec3(float(8 * block[0] + x), float(8 * block[1] + y), float(8 * block[2] + z))
                direction = wp.vec3(float(step[0]), float(step[1]), float(step[2]))
                vertices[vertex] = voxel_size * (start + along * direction)
                # A voxel without colour is left out of the interpolation.
                share_a = wp.where(sums_a.color_weight > 0.0, 1.0 - along, 0.0)
                share_b = wp.where(sums_b.color_weight > 0.0, along, 0.0)
                if share_a + share_b > 0.0:
                    mixed = wp.vec3()
                    if share_a > 0.0:
                        mixed += share_a / sums_a.color_weight * sums_a.color
                    if share_b > 0.0:
                        mixed += share_b / sums_b.color_weight * sums_b.color
                    colors[vertex] = mixed / (share_a + share_b)
                vertex += 1


@wp.kernel
def _emit_triangles(
    first: int,
    neighbours: wp.array2d(dtype=int),
    cases: wp.array(dtype=wp.uint8),
    edge_used: wp.array2d(dtype=wp.uint8),
    row_vertices: wp.array(dtype=int),
    row_triangles: wp.array(dtype=int),
    edge_corners: wp.array2d(dtype=int),
    triangle_counts: wp.array(dtype=int),
    triangle_edges: wp.array2d(dtype=int),
    triangles: wp.array2d(dtype=int),
) -> None:
    row = wp.tid() + first
    number = row / _ROWS
    y = row & 7
    z = (row >> 3) & 7
    triangle = row_triangles[row]
    for x in range(8):
        case = int(cases[8 * row + x])
        for i in range(triangle_counts[case]):
            for j in range(3):
                edge = triangle_edges[case, 3 * i + j]
                low = edge_corners[edge, 0]
                owner = voxel_index(neighbours, number, x + (low & 1), y + ((low >> 1) & 1), z + (low >> 2))
                triangles[triangle, j] = vertex_number(row_vertices, edge_used, owner, edge / 4)
            triangle += 1


def marching_cubes(volume: Volume) -> Mesh:
    """Return the zero level of the volume's average distance as a mesh in world coordinates, with colours.

    Vertices are placed by linear interpolation along voxel edges. Where the volume holds no surface the mesh is empty.
    """
    blocks = volume.table.count
    if blocks == 0:
        return _empty_mesh()
    counts, edges = triangle_table()
    tables = CaseTables(
        edge_corners=wp.array(EDGE_CORNERS, dtype=int, device=volume.device),
        triangle_counts=wp.array(counts, dtype=int, device=volume.device),
        triangle_edges=wp.array(edges, dtype=int, device=volume.device),
    )
    cells = classify_cells(volume, tables)
    vertex_total = _scan(cells.row_vertices)
    triangle_total = _scan(cells.row_triangles)
    if triangle_total == 0:
        return _empty_mesh()

    vertices = wp.empty(vertex_total, dtype=wp.vec3, device=volume.device)
    colors = wp.zeros(vertex_total, dtype=wp.vec3, device=volume.device)
    triangles = wp.empty((triangle_total, 3), dtype=int, device=volume.device)
    launch_in_slabs(
        _emit_vertices,
        dim=blocks * BLOCK_SIDE**2,
        inputs=[
            volume.table.blocks,
            cells.neighbours,
            cells.edge_used,
            cells.row_vertices,
            volume.voxels,
            volume.voxel_size,
        ],
        outputs=[vertices, colors],
        device=volume.device,
    )
    launch_in_slabs(
        _emit_triangles,
        dim=blocks * BLOCK_SIDE**2,
        inputs=[
            cells.neighbours,
            cells.cases,
            cells.edge_used,
            cells.row_vertices,
            cells.row_triangles,
            tables.edge_corners,
            tables.triangle_counts,
            tables.triangle_edges,
        ],
        outputs=[triangles],
        device=volume.device,
    )
    return Mesh(
        vertices=vertices.numpy(),
        triangles=triangles.numpy(),
        colors=np.rint(colors.numpy()).clip(0, 255).astype(np.uint8),
    )


def _scan(counts: wp.array) -> int:
    """Replace counts by the sum of those before, in place, and return the total."""
    last = int(counts[-1:].numpy()[0])
    array_scan(counts, counts, inclusive=False)
    return last + int(counts[-1:].numpy()[0])


def _empty_mesh() -> Mesh:
    return Mesh(
        vertices=np.zeros((0, 3), np.float32), triangles=np.zeros((0, 3), np.int32), colors=np.zeros((0, 3), np.uint8)
    )
