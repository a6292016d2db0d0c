"""Cells are merged where the surface is flat: one vertex serves a box of them, within a tolerance that is checked.

The largest boxes that might do (``merge_boxes``) are split where a line between two of their vertices leaves them, for
then the mesh might meet itself (``box_quads``); and where it is off the mesh of cells (``box_flatness``).
"""

import numpy as np
import warp as wp

from fusion.surface.dual_contouring.cell_merging.box_flatness import BoxFlatness
from fusion.surface.dual_contouring.cell_merging.box_quads import cut_quads_of_boxes
from fusion.surface.dual_contouring.cell_merging.box_tree import BoxTree
from fusion.surface.dual_contouring.dual_grid import DualGrid
from fusion.surface.dual_contouring.quads import Cuts, count_anew
from fusion.surface.dual_contouring.vertices import Vertices
from fusion.surface.mesh import Mesh
from fusion.volume.tsdf_volume import Volume


def merge_cells(
    volume: Volume, grid: DualGrid, cuts: Cuts, along: wp.array, places: wp.array, cells: Vertices, *, flatness: float
) -> Cuts:
    """Merge cells, whose vertices are at ``places``, where the mesh stays within ``flatness`` voxels.

    Writes the vertices of the boxes in the place of the first of their ``cells``' each, and returns quads between them.
    """
    tree = BoxTree(grid, places, cells.normals, flatness=flatness)
    check = BoxFlatness(volume, grid, cuts.corners, cuts.splits, along, places, flatness=flatness)
    splits = wp.empty_like(cuts.splits)
    while True:
        cut_quads_of_boxes(grid, along, cuts.corners, tree.boxes, cuts.splits, splits)
        if not tree.boxes.refused.numpy().any() and not check.refuse_far(tree, splits):
            break
        tree.split_refused()
    tree.write(volume, cells)
    owners = tree.boxes.owners.numpy()[check.corners]
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
