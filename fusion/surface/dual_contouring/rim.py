"""Rim edges: crossed edges around which some of the four cells were seen, but not all. The mesh ends there.

It ends where the observed region does, on the faces that have a seen cell on one side only; as marching cubes' mesh,
along the lines between the 1-D points of such a face's edges, which are vertices here. ``rim_polygons`` has what lies
within the seen cells. Where these are two that touch in the edge alone, the surfaces in them are apart, and each has a
vertex of its own.

Cells around an edge are numbered counter-clockwise, as ``quad_corners`` does: 0 is the voxel's own, 1 and 2 are one
back along the second axis (the next after the edge's), 2 and 3 along the third.
"""

import warp as wp

from fusion.devices import sum_before
from fusion.surface.dual_contouring.dual_grid import DualGrid, complete_along, place_of, vertex_of_edge
from fusion.surface.layers import NONE, below, corners_back, launch_over_layers, step_along

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def rim_along(grid: DualGrid, layer: int, axis: int) -> wp.uint64:
    """Return the voxels of a layer whose edge along an axis is a rim edge; the layer has crossed edges."""
    return grid.cells.edges[layer, axis] & ~complete_along(grid, layer, axis)


@wp.func
def has_rim(grid: DualGrid, layer: int) -> bool:
    """Return whether a layer has rim edges."""
    if grid.cells.starts[layer][0] == grid.cells.starts[layer + 1][0]:
        return False
    return (rim_along(grid, layer, 0) | rim_along(grid, layer, 1) | rim_along(grid, layer, 2)) != NONE


@wp.func
def cells_around(here: wp.vec4ul, under: wp.vec4ul, axis: int) -> wp.vec4ul:
    """Return what is true of the four cells around edges along an axis, from the words of this layer and that under."""
    if axis == 0:
        return wp.vec4ul(here[0], here[2], under[2], under[0])
    if axis == 1:
        return wp.vec4ul(here[0], under[0], under[1], here[1])
    return wp.vec4ul(here[0], here[1], here[3], here[2])


@wp.kernel
def _find_rim(first: int, grid: DualGrid) -> None:
    layer = wp.tid() + first
    vertices = int(0)
    if has_rim(grid, layer):
        here = corners_back(grid.cells.active, grid.cells.lower, layer >> 3, layer & 7)
        under = corners_back(grid.cells.active, grid.cells.lower, layer >> 3, (layer & 7) - 1)
        for axis in range(3):
            rim = rim_along(grid, layer, axis)
            around = cells_around(here, under, axis)
            parted = around[0] & around[2] & ~around[1] & ~around[3]
            parted = rim & (parted | (around[1] & around[3] & ~around[0] & ~around[2]))
            grid.parted[layer, axis] = parted
            vertices += wp.bit_count(rim) + wp.bit_count(parted)
    grid.rim_starts[layer] = vertices


def find_rim(grid: DualGrid) -> int:
    """Find the rim's vertices (``grid.parted``, ``rim_starts``) and return how many there are."""
    layers = len(grid.several)
    launch_over_layers(_find_rim, dim=layers, inputs=[], outputs=[grid], device=grid.several.device)
    sum_before(grid.rim_starts)
    return int(grid.rim_starts[layers:].numpy()[0])


@wp.func
def rim_vertex(grid: DualGrid, layer: int, axis: int, bit: int, cell: int) -> int:
    """Return the number of the vertex on a rim edge, for the surface in one of the seen ``cell`` around it (0 to 3)."""
    before = below(bit)
    number = grid.rim_starts[layer] + wp.bit_count(rim_along(grid, layer, axis) & before)
    number += wp.bit_count(grid.parted[layer, axis] & before)
    for other in range(axis):
        number += wp.bit_count(rim_along(grid, layer, other)) + wp.bit_count(grid.parted[layer, other])
    if ((grid.parted[layer, axis] >> wp.uint64(bit)) & wp.uint64(1)) != NONE:
        number += cell >> 1
    return number


@wp.func
def steps_back(axis: int, cell: int) -> wp.vec3i:
    """Return how far back from an edge's voxel a cell around it is."""
    second = wp.where(cell == 1 or cell == 2, 1, 0)
    return second * step_along((axis + 1) % 3) + (cell >> 1) * step_along((axis + 2) % 3)


@wp.func
def cell_at(axis: int, back: wp.vec3i) -> int:
    """Return which cell around an edge is so far back from its voxel: the inverse of ``steps_back``."""
    second = back[(axis + 1) % 3]
    third = back[(axis + 2) % 3]
    return wp.where(third == 1, 3 - second, second)


@wp.func
def vertex_in_cell(grid: DualGrid, slot: int, voxel: wp.vec3i, axis: int, cell: int) -> int:
    """Return the number of the vertex that a cell around a voxel's edge has for it, −1 where it was not seen."""
    back = steps_back(axis, cell)
    at = voxel - back
    place = place_of(grid.cells.lower, slot, at[0], at[1], at[2])
    low = wp.where(axis == 0, back[1], back[0])
    high = wp.where(axis == 2, back[1], back[2])
    return vertex_of_edge(grid, place[0], place[1], 4 * axis + low + 2 * high)
