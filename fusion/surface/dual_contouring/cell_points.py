"""3-D points: the vertices within cells.

Where an oracle was asked they are where the planes through the cell's 1-D points meet. A plane's normal comes from the
2-D points of the two curves that meet in the 1-D point. Planes of the trilinear field's gradients tell no more than the
1-D points do, whose centroid is taken there (``close_gaps`` goes on from it). In a cell with several loops each vertex
is the centroid of its loop, which lies within the loop's hull whatever the loop is.
"""

import warp as wp

from fusion.devices import launch_in_slabs
from fusion.surface.dual_contouring.cell_table import CellTables, cell_tables
from fusion.surface.dual_contouring.cells_from_faces import solve_cells_from_faces
from fusion.surface.dual_contouring.dual_grid import Counts, DualGrid, first_vertex
from fusion.surface.dual_contouring.layer_solver import solve_layer
from fusion.surface.dual_contouring.vertices import VertexRoom, Vertices
from fusion.surface.layers import NONE, below, launch_over_layers, lowest_bit, number_of, share_of, shares_on
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxels import Voxels

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


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
    active = grid.cells.active[layer] & share_of(index - layer * shares, shares)
    if active == NONE:
        return
    slot = layer >> 3
    lowest = lowest_bit(active)
    corner = 8 * blocks[number_of(grid.cells, slot)]
    solve_layer(
        grid,
        tables,
        slot,
        layer & 7,
        active,
        first_vertex(grid, layer, lowest),
        grid.vertex_starts[layer][1] + wp.bit_count(grid.several[layer] & below(lowest)),
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


def cell_points(
    volume: Volume,
    grid: DualGrid,
    counts: Counts,
    along: wp.array,
    curve_points: wp.array | None,
    *,
    room: VertexRoom,
) -> tuple[wp.array, Vertices]:
    """Return the vertices within cells, in ``room``, and where in their cells they are (vertices,), in voxels.

    Their planes come from ``curve_points``. Without these they are still to be moved (``close_gaps``).
    """
    device, shares = volume.device, shares_on(volume.device)
    places = wp.empty(counts.vertices, dtype=wp.vec3, device=device)
    vertices = room.take(counts.vertices)
    inputs = [shares, grid, cell_tables(str(device.alias)), volume.table.blocks, volume.voxels, volume.voxel_size]
    outputs = [places, vertices.points, vertices.colors, vertices.normals]
    dim = shares * len(grid.several)
    if curve_points is None:
        launch_over_layers(_solve_cells, dim=dim, inputs=inputs, outputs=outputs, device=device)
    else:
        inputs += [along, curve_points]
        launch_in_slabs(solve_cells_from_faces, dim=dim, inputs=inputs, outputs=outputs, device=device, least_slab=64)
    return places, vertices
