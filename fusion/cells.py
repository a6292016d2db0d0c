"""The cells of the sparse grid: between which voxels the surface passes, and which voxel edges carry a vertex.

A cell's corners are eight neighbouring voxels, of up to eight blocks. It has a surface only where all of them were
observed, so unseen space never makes any. Vertices lie on voxel edges and are shared by the cells around them.
"""

from dataclasses import dataclass

import warp as wp

from fusion.block_table import BLOCK_SIDE, BLOCK_VOXELS, find_block
from fusion.devices import launch_in_slabs
from fusion.volume import Volume
from fusion.voxels import Voxels, distance_of, weight_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_ROWS = wp.constant(BLOCK_SIDE * BLOCK_SIDE)
_VOXELS = wp.constant(BLOCK_VOXELS)

UNSEEN = wp.constant(wp.uint8(0))
OUTSIDE = wp.constant(wp.uint8(1))
INSIDE = wp.constant(wp.uint8(2))


@dataclass(frozen=True, kw_only=True)
class CaseTables:
    """The marching cubes table on a device: ``edge_corners`` (12, 2), counts and edges of the 256 cases."""

    edge_corners: wp.array
    triangle_counts: wp.array
    triangle_edges: wp.array


@dataclass(frozen=True, kw_only=True)
class Cells:
    """Where the surface passes, for n blocks; a row is eight voxels along x.

    ``states`` (512 n) UNSEEN, OUTSIDE or INSIDE; ``cases`` (512 n) sign patterns, 0 where a corner is unseen;
    ``edge_used`` (3, 512 n) 1 where the edge from a voxel along an axis carries a vertex; ``row_vertices``,
    ``row_triangles`` (64 n) how many vertices and triangles lie in the rows before, after the scan.
    """

    neighbours: wp.array
    states: wp.array
    cases: wp.array
    edge_used: wp.array
    row_vertices: wp.array
    row_triangles: wp.array


@wp.kernel
def _find_neighbours(
    blocks: wp.array(dtype=wp.vec3i),
    keys: wp.array(dtype=wp.int64),
    numbers: wp.array(dtype=int),
    neighbours: wp.array2d(dtype=int),
) -> None:
    number, corner = wp.tid()
    step = wp.vec3i(corner & 1, (corner >> 1) & 1, (corner >> 2) & 1)
    neighbours[number, corner] = find_block(keys, numbers, blocks[number] + step)


@wp.func
def voxel_index(neighbours: wp.array2d(dtype=int), number: int, x: int, y: int, z: int) -> int:
    """Return the index of voxel (x, y, z), each 0 to 8, seen from a block; −1 where its block does not exist."""
    holder = neighbours[number, (x >> 3) + 2 * (y >> 3) + 4 * (z >> 3)]
    if holder < 0:
        return -1
    return holder * _VOXELS + (z & 7) * 64 + (y & 7) * 8 + (x & 7)


@wp.kernel
def _voxel_states(
    first: int,
    voxels: Voxels,
    states: wp.array(dtype=wp.uint8),
) -> None:
    voxel = wp.tid() + first
    state = UNSEEN
    if weight_of(voxels, voxel) > 0.0:
        state = wp.where(distance_of(voxels, voxel) < 0.0, INSIDE, OUTSIDE)
    states[voxel] = state


@wp.kernel
def _classify_cells(
    first: int,
    neighbours: wp.array2d(dtype=int),
    states: wp.array(dtype=wp.uint8),
    edge_corners: wp.array2d(dtype=int),
    cases: wp.array(dtype=wp.uint8),
    edge_used: wp.array2d(dtype=wp.uint8),
) -> None:
    cell = wp.tid() + first
    cases[cell] = wp.uint8(0)
    if states[cell] == UNSEEN:
        return
    number = cell / _VOXELS
    local = cell - number * _VOXELS
    x = local & 7
    y = (local >> 3) & 7
    z = local >> 6
    case = int(0)
    for corner in range(8):
        voxel = voxel_index(neighbours, number, x + (corner & 1), y + ((corner >> 1) & 1), z + (corner >> 2))
        if voxel < 0:
            return
        state = states[voxel]
        if state == UNSEEN:
            return
        if state == INSIDE:
            case = case | (1 << corner)
    if case == 0 or case == 255:
        return
    cases[cell] = wp.uint8(case)
    for edge in range(12):
        low = edge_corners[edge, 0]
        high = edge_corners[edge, 1]
        if ((case >> low) & 1) != ((case >> high) & 1):
            # Cells around an edge may all write here, and all write the same.
            owner = voxel_index(neighbours, number, x + (low & 1), y + ((low >> 1) & 1), z + (low >> 2))
            edge_used[edge / 4, owner] = wp.uint8(1)


@wp.kernel
def _count_rows(
    first: int,
    cases: wp.array(dtype=wp.uint8),
    edge_used: wp.array2d(dtype=wp.uint8),
    triangle_counts: wp.array(dtype=int),
    row_vertices: wp.array(dtype=int),
    row_triangles: wp.array(dtype=int),
) -> None:
    row = wp.tid() + first
    vertices = int(0)
    triangles = int(0)
    for i in range(8):
        voxel = 8 * row + i
        vertices += int(edge_used[0, voxel]) + int(edge_used[1, voxel]) + int(edge_used[2, voxel])
        triangles += triangle_counts[int(cases[voxel])]
    row_vertices[row] = vertices
    row_triangles[row] = triangles


def classify_cells(volume: Volume, tables: CaseTables) -> Cells:
    """Find the cells that the surface crosses and the edges that carry vertices, and count them by rows."""
    device, table = volume.device, volume.table
    voxels = table.count * BLOCK_VOXELS
    cells = Cells(
        neighbours=wp.empty((table.count, 8), dtype=int, device=device),
        states=wp.empty(voxels, dtype=wp.uint8, device=device),
        cases=wp.empty(voxels, dtype=wp.uint8, device=device),
        edge_used=wp.zeros((3, voxels), dtype=wp.uint8, device=device),
        row_vertices=wp.empty(voxels // BLOCK_SIDE, dtype=int, device=device),
        row_triangles=wp.empty(voxels // BLOCK_SIDE, dtype=int, device=device),
    )
    wp.launch(
        _find_neighbours,
        dim=(table.count, 8),
        inputs=[table.blocks, table.keys, table.numbers],
        outputs=[cells.neighbours],
        device=device,
    )
    launch_in_slabs(_voxel_states, dim=voxels, inputs=[volume.voxels], outputs=[cells.states], device=device)
    launch_in_slabs(
        _classify_cells,
        dim=voxels,
        inputs=[cells.neighbours, cells.states, tables.edge_corners],
        outputs=[cells.cases, cells.edge_used],
        device=device,
    )
    launch_in_slabs(
        _count_rows,
        dim=voxels // BLOCK_SIDE,
        inputs=[cells.cases, cells.edge_used, tables.triangle_counts],
        outputs=[cells.row_vertices, cells.row_triangles],
        device=device,
    )
    return cells
