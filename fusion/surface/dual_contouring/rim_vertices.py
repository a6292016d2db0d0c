"""The vertices on rim edges, at their 1-D points."""

import warp as wp

from fusion.devices import launch_in_slabs
from fusion.surface.dual_contouring.dual_grid import DualGrid
from fusion.surface.dual_contouring.rim import rim_along, vertex_in_cell
from fusion.surface.dual_contouring.vertices import VertexArrays, VertexRoom, Vertices
from fusion.surface.layers import NONE, lowest_bit, number_of, step_along, vertex_number, voxel_of
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxel_average import average_of, color_along
from fusion.volume.voxels import Voxels

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def color_on_edge(grid: DualGrid, voxels: Voxels, slot: int, voxel: wp.vec3i, axis: int, share: float) -> wp.vec3ub:
    """Return the colour at a ``share`` of the way along a voxel's edge."""
    on = voxel + step_along(axis)
    a = average_of(voxels, voxel_of(grid.cells, slot, voxel[0], voxel[1], voxel[2]))
    b = average_of(voxels, voxel_of(grid.cells, slot, on[0], on[1], on[2]))
    return color_along(a, b, share)


@wp.kernel
def _place_vertices(
    first: int,
    grid: DualGrid,
    blocks: wp.array(dtype=wp.vec3i),
    voxels: Voxels,
    voxel_size: float,
    along: wp.array(dtype=float),
    cells: VertexArrays,
    vertices: VertexArrays,
) -> None:
    layer = wp.tid() + first
    vertex = grid.rim_starts[layer]
    if vertex == grid.rim_starts[layer + 1]:
        return
    slot = layer >> 3
    corner = 8 * blocks[number_of(grid.cells, slot)]
    for axis in range(3):
        left = rim_along(grid, layer, axis)
        while left != NONE:
            bit = lowest_bit(left)
            voxel = wp.vec3i(bit & 7, bit >> 3, layer & 7)
            share = along[vertex_number(grid.cells, layer, axis, bit)]
            color = color_on_edge(grid, voxels, slot, voxel, axis, share)
            at = corner + voxel
            point = wp.vec3(float(at[0]), float(at[1]), float(at[2]))
            point[axis] += share
            copies = wp.where(((grid.parted[layer, axis] >> wp.uint64(bit)) & wp.uint64(1)) != NONE, 2, 1)
            for copy in range(copies):
                vertices.points[vertex] = voxel_size * point
                vertices.colors[vertex] = color
                if vertices.normals.shape[0] > 0:
                    normal = wp.vec3()
                    for cell in range(4):
                        # A copy's one cell is 0 or 1, or else 2 or 3.
                        if copies == 1 or (cell >> 1) == copy:
                            around = vertex_in_cell(grid, slot, voxel, axis, cell)
                            if around >= 0:
                                normal += cells.normals[around]
                    vertices.normals[vertex] = wp.normalize(normal)
                vertex += 1
            left = left & (left - wp.uint64(1))


def rim_vertices(
    volume: Volume, grid: DualGrid, rim: int, along: wp.array, cells: Vertices, *, room: VertexRoom
) -> Vertices:
    """Return the vertices on rim edges, in ``room``, at their 1-D points, with the colours of the voxels there.

    Their normals are those of the ``cells``' vertices around.
    """
    vertices = room.take(rim)
    launch_in_slabs(
        _place_vertices,
        dim=len(grid.several) if rim else 0,
        inputs=[grid, volume.table.blocks, volume.voxels, volume.voxel_size, along, cells.arrays()],
        outputs=[vertices.arrays()],
        device=volume.device,
        least_slab=256,
    )
    return vertices
