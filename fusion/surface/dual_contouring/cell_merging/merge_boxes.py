"""Which boxes one vertex may serve, and where it is: nearest to the planes through the vertices of the box's cells."""

import warp as wp

from fusion.surface.dual_contouring.cell_merging.box_topology import is_disc
from fusion.surface.dual_contouring.cell_merging.boxes import (
    EMPTY,
    LEVELS,
    MERGED,
    NOT_MERGED,
    Boxes,
    box_number,
    corner_of_box,
    word_of_box,
)
from fusion.surface.dual_contouring.cell_merging.tame_cells import CellWords
from fusion.surface.dual_contouring.cell_table import CellTables, cell_tables
from fusion.surface.dual_contouring.dual_grid import DualGrid, first_vertex
from fusion.surface.dual_contouring.lanes import ONE_LANE_IN_CPP
from fusion.surface.dual_contouring.qef import QEF_IN_CPP
from fusion.surface.layers import NONE, launch_over_layers, lowest_bit

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def state_of_half(words: CellWords, boxes: Boxes, slot: int, level: int, at: wp.vec3i) -> wp.uint8:
    """Return what a half of a box of a level is, a smaller box or a cell: of the ``states``."""
    if level > 1:
        return boxes.states[box_number(slot, level - 1, at)]
    layer = 8 * slot + at[2]
    one = wp.uint64(1) << wp.uint64(8 * at[1] + at[0])
    if (words.tame[layer] & one) != NONE:
        return MERGED
    if (words.empty[layer] & one) != NONE:
        return EMPTY
    return NOT_MERGED


_MINIMISE_IN_CPP = (
    ONE_LANE_IN_CPP
    + QEF_IN_CPP
    + """
    const float weight = WEIGHT * (count + 1.0f), share = weight / count;
    Equations e = {squares.data[0][0] + weight, squares.data[0][1], squares.data[0][2],
                   squares.data[1][1] + weight, squares.data[1][2], squares.data[2][2] + weight};
    for (int i = 0; i < 3; ++i) e.right[i] = right[i] + share * points[i];
    float best[3];
    solve(e, best);
    keep_within_cell(e, 0, best);
    return wp::vec3(best[0], best[1], best[2]);
"""
)


@wp.func_native(_MINIMISE_IN_CPP)
def nearest_point(inset: float, squares: wp.mat33, right: wp.vec3, points: wp.vec3, count: float) -> wp.vec3:
    """Return the point of the unit cube nearest to planes, from the sums of n nᵀ, of n (n·p), and of p."""


@wp.struct
class Planes:
    """The sums of n nᵀ, of n (n·p), and of p over the vertices p of a box's cells, and how many there are.

    Points are in sides of the box from its lowest corner; ``first`` is the least number of a vertex.
    """

    squares: wp.mat33
    right: wp.vec3
    points: wp.vec3
    count: float
    first: int


@wp.func
def planes_in_box(
    grid: DualGrid,
    slot: int,
    corner: wp.vec3i,
    side: int,
    cell_places: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
) -> Planes:
    """Return the planes through the vertices of a box's cells, which have one each."""
    sums = Planes()
    sums.first = -1
    word = word_of_box(corner, side)
    for z in range(side):
        layer = 8 * slot + corner[2] + z
        left = grid.cells.active[layer] & word
        while left != NONE:
            bit = lowest_bit(left)
            vertex = first_vertex(grid, layer, bit)
            if sums.first < 0:
                sums.first = vertex
            cell = wp.vec3(float((bit & 7) - corner[0]), float((bit >> 3) - corner[1]), float(z))
            point = (cell + cell_places[vertex]) / float(side)
            normal = normals[vertex]
            sums.squares += wp.outer(normal, normal)
            sums.right += wp.dot(normal, point) * normal
            sums.points += point
            sums.count += 1.0
            left = left & (left - wp.uint64(1))
    return sums


@wp.func
def error_in_box(
    grid: DualGrid,
    slot: int,
    corner: wp.vec3i,
    side: int,
    cell_places: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    place: wp.vec3,
) -> float:
    """Return the sum of squared distances, in voxels, of a place in a box from these planes."""
    error = float(0.0)
    word = word_of_box(corner, side)
    for z in range(side):
        layer = 8 * slot + corner[2] + z
        left = grid.cells.active[layer] & word
        while left != NONE:
            bit = lowest_bit(left)
            vertex = first_vertex(grid, layer, bit)
            cell = wp.vec3(float((bit & 7) - corner[0]), float((bit >> 3) - corner[1]), float(z))
            off = wp.dot(normals[vertex], place - cell - cell_places[vertex])
            error += off * off
            left = left & (left - wp.uint64(1))
    return error


@wp.func
def state_of_box(
    grid: DualGrid, tables: CellTables, words: CellWords, boxes: Boxes, slot: int, level: int, corner: wp.vec3i
) -> wp.uint8:
    """Return whether a box may be merged for its halves and its topology, or is empty: of the ``states``."""
    half = (1 << level) >> 1
    some = bool(False)
    for child in range(8):
        at = corner + half * wp.vec3i(child & 1, (child >> 1) & 1, child >> 2)
        state = state_of_half(words, boxes, slot, level, at)
        if state == NOT_MERGED:
            return NOT_MERGED
        some = some or state == MERGED
    if not some:
        return EMPTY
    if is_disc(words.inside, grid.cells.upper, tables, slot, corner, half):
        return MERGED
    return NOT_MERGED


@wp.kernel
def _merge(
    first: int,
    level: int,
    grid: DualGrid,
    tables: CellTables,
    words: CellWords,
    cell_places: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    flatness: float,
    boxes: Boxes,
) -> None:
    index = wp.tid() + first
    count = 512 >> (3 * level)
    slot = index // count
    corner = corner_of_box(level, index - slot * count)
    number = box_number(slot, level, corner)
    state = state_of_box(grid, tables, words, boxes, slot, level, corner)
    if state == MERGED:
        side = 1 << level
        sums = planes_in_box(grid, slot, corner, side, cell_places, normals)
        inset = grid.inset / float(side)
        place = float(side) * nearest_point(inset, sums.squares, sums.right, sums.points, sums.count)
        error = error_in_box(grid, slot, corner, side, cell_places, normals, place)
        if error > flatness * flatness * sums.count:
            state = NOT_MERGED
        boxes.first[number] = sums.first
        boxes.places[number] = place
    boxes.states[number] = state


def merge_boxes(
    grid: DualGrid, words: CellWords, places: wp.array, normals: wp.array, boxes: Boxes, *, flatness: float
) -> None:
    """Find which boxes one vertex may serve (``states``, ``first``, ``places``), level by level.

    Its root mean square distance from the planes through its cells' vertices is at most ``flatness`` voxels.
    """
    device = places.device
    for level in range(1, LEVELS + 1):
        launch_over_layers(
            _merge,
            dim=len(grid.several) // 8 * (512 >> (3 * level)),
            inputs=[level, grid, cell_tables(str(device.alias)), words, places, normals, flatness],
            outputs=[boxes],
            device=device,
        )
