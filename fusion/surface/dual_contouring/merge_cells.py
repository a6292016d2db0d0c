"""Cells are merged where the surface is flat: one vertex serves a box of them, within a tolerance that holds.

The largest boxes that might do (``boxes``) are split where a line between two of their vertices leaves them, for then
the mesh might meet itself (``box_quads``); and where a vertex of a cell is farther from the mesh than the tolerance.
"""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from fusion.surface.closest_points import closest_points
from fusion.surface.dual_contouring.box_quads import cut_quads_of_boxes
from fusion.surface.dual_contouring.boxes import Boxes, BoxTree
from fusion.surface.dual_contouring.dual_grid import DualGrid, complete_along, first_vertex
from fusion.surface.dual_contouring.quad_split import FAN, WITHOUT_CORNER
from fusion.surface.dual_contouring.quads import Cuts, count_anew
from fusion.surface.dual_contouring.vertices import Vertices
from fusion.surface.layers import NONE, launch_over_layers, lowest_bit, number_of, vertex_number
from fusion.surface.mesh import Mesh
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.kernel
def _place_on_lattice(
    first: int,
    grid: DualGrid,
    blocks: wp.array(dtype=wp.vec3i),
    origin: wp.vec3i,
    cell_places: wp.array(dtype=wp.vec3),
    boxes: Boxes,
    along: wp.array(dtype=float),
    fine: wp.array(dtype=wp.vec3),
    coarse: wp.array(dtype=wp.vec3),
    crossings: wp.array(dtype=wp.vec3),
) -> None:
    layer = wp.tid() + first
    corner = 8 * (blocks[number_of(grid.cells, layer >> 3)] - origin)
    left = grid.cells.active[layer]
    while left != NONE:
        bit = lowest_bit(left)
        vertex = first_vertex(grid, layer, bit)
        cell = corner + wp.vec3i(bit & 7, bit >> 3, layer & 7)
        side = 1 << int(boxes.levels[vertex])
        fine[vertex] = wp.vec3(float(cell[0]), float(cell[1]), float(cell[2])) + cell_places[vertex]
        low = wp.vec3(float(cell[0] & -side), float(cell[1] & -side), float(cell[2] & -side))
        if boxes.owners[vertex] == vertex:
            coarse[vertex] = low + boxes.owner_places[vertex]
        left = left & (left - wp.uint64(1))
    quad = grid.quad_starts[layer]
    if quad == grid.quad_starts[layer + 1]:
        return
    for axis in range(3):
        left = complete_along(grid, layer, axis)
        while left != NONE:
            bit = lowest_bit(left)
            voxel = corner + wp.vec3i(bit & 7, bit >> 3, layer & 7)
            point = wp.vec3(float(voxel[0]), float(voxel[1]), float(voxel[2]))
            point[axis] += along[vertex_number(grid.cells, layer, axis, bit)]
            crossings[quad] = point
            quad += 1
            left = left & (left - wp.uint64(1))


def _triangles(corners: NDArray[np.int32], splits: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Return the triangles (m, 3) that quads are cut into, of vertices and, from number −1 down, the quads' crossings.

    Some have a corner twice.
    """
    one, two, fan = (splits >= WITHOUT_CORNER), splits < FAN, splits == FAN
    found = []
    turned = np.take_along_axis(corners[one], (splits[one, None] - WITHOUT_CORNER + np.arange(1, 4)) & 3, axis=1)
    found.append(turned)
    turned = np.take_along_axis(corners[two], (splits[two, None] + np.arange(4)) & 3, axis=1)
    found += [turned[:, [0, 1, 2]], turned[:, [0, 2, 3]]]
    middles = -1 - np.flatnonzero(fan)[:, None]
    for side in range(4):
        found.append(np.hstack([middles, corners[fan][:, [side, (side + 1) & 3]]]))
    return np.concatenate(found).astype(np.int32)


def _refuse_far(
    volume: Volume, grid: DualGrid, tree: BoxTree, corners: wp.array, splits: wp.array, along: wp.array, flatness: float
) -> bool:
    """Refuse boxes from which a cell's vertex is more than ``flatness`` voxels away; return whether there are any."""
    boxes, device = tree.boxes, volume.device
    levels, owners = boxes.levels.numpy(), boxes.owners.numpy()
    merged = np.flatnonzero(levels)
    if len(merged) == 0:
        return False
    fine, coarse = (wp.empty(len(levels), dtype=wp.vec3, device=device) for _ in range(2))
    crossings = wp.empty(len(corners), dtype=wp.vec3, device=device)
    origin = wp.vec3i(*volume.table.blocks[:1].numpy()[0].tolist())
    launch_over_layers(
        _place_on_lattice,
        dim=len(grid.several),
        inputs=[grid, volume.table.blocks, origin, tree.places, boxes, along],
        outputs=[fine, coarse, crossings],
        device=device,
    )
    some = (levels[corners.numpy()] > 0).any(axis=1)
    triangles = _triangles(owners[corners.numpy()[some]], splits.numpy()[some])
    distinct = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    triangles = triangles[distinct]
    # Crossings follow the vertices.
    triangles = np.where(triangles < 0, len(levels) - 1 - triangles, triangles).astype(np.int32)
    used, triangles = np.unique(triangles, return_inverse=True)
    points = np.concatenate([coarse.numpy(), crossings.numpy()[some]])[used]
    mesh = Mesh(vertices=points, triangles=triangles.reshape(-1, 3).astype(np.int32))
    far = merged[closest_points(mesh, fine.numpy()[merged], device=device).distances > flatness]
    refused = boxes.refused.numpy()
    refused[owners[far]] = 1
    boxes.refused.assign(refused)
    return len(far) > 0


def merge_cells(
    volume: Volume, grid: DualGrid, cuts: Cuts, along: wp.array, places: wp.array, cells: Vertices, *, flatness: float
) -> Cuts:
    """Merge cells whose vertices, at ``places``, are within ``flatness`` voxels of the mesh then.

    Writes the vertices of the boxes in the place of the first of their ``cells``' each, and returns quads between them.
    """
    tree = BoxTree(grid, places, cells.normals, flatness=flatness)
    splits = wp.empty_like(cuts.splits)
    while True:
        cut_quads_of_boxes(grid, along, cuts.corners, tree.boxes, cuts.splits, splits)
        if not tree.boxes.refused.numpy().any() and not _refuse_far(
            volume, grid, tree, cuts.corners, splits, along, flatness
        ):
            break
        tree.split_refused()
    tree.write(volume, cells)
    owners = tree.boxes.owners.numpy()[cuts.corners.numpy()]
    return count_anew(grid, wp.array(owners, dtype=wp.vec4i, device=volume.device), splits)


def without_unused_vertices(mesh: Mesh) -> Mesh:
    """Return a mesh without the vertices that no triangle has."""
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.triangles] = True
    numbers = np.cumsum(used, dtype=np.int32) - 1
    return Mesh(
        vertices=mesh.vertices[used],
        triangles=numbers[mesh.triangles],
        colors=None if mesh.colors is None else mesh.colors[used],
        normals=None if mesh.normals is None else mesh.normals[used],
    )
