"""Boxes of 2, 4 and 8 cells a side, each within a block: where the surface is flat, one vertex serves a whole box.

A box takes the place of its eight halves where the surface in them is a disc (``box_topology``), and where a point is
near to the planes through their cells' vertices: the one that is nearest to all of them becomes the box's vertex. The
largest such boxes hold, until one is split.
"""

from typing import Any

import warp as wp

from fusion.surface.dual_contouring.box_topology import is_disc
from fusion.surface.dual_contouring.cell_table import CellTables, cell_tables
from fusion.surface.dual_contouring.dual_grid import DualGrid, first_vertex
from fusion.surface.dual_contouring.lanes import ONE_LANE_IN_CPP
from fusion.surface.dual_contouring.qef import QEF_IN_CPP
from fusion.surface.dual_contouring.tame_cells import CellWords, find_tame_cells
from fusion.surface.dual_contouring.vertices import Vertices, as_bytes
from fusion.surface.layers import NONE, launch_over_layers, lowest_bit, number_of
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

LEVELS = 3
BOXES = 64 + 8 + 1
"""Of a block, of all levels."""
NOT_MERGED, MERGED, EMPTY = 0, 1, 2
_NOT_MERGED = wp.constant(wp.uint8(NOT_MERGED))
_MERGED = wp.constant(wp.uint8(MERGED))
_EMPTY = wp.constant(wp.uint8(EMPTY))
_BOXES = wp.constant(BOXES)
_LEVELS = wp.constant(LEVELS)


@wp.struct
class Boxes:
    """By boxes (BOXES · slots,): ``states``, the least number of their cells' vertices, and where their own vertex is.

    ``places`` are in voxels from the box's lowest corner. By vertices of cells (n,): the ``owners``, numbers of the
    vertices that take their place, the ``levels`` of the boxes that these serve, 0 for a cell, and where they are
    there, ``owner_places``; ``refused`` is set for owners whose box is to be split.
    """

    states: wp.array(dtype=wp.uint8)
    first: wp.array(dtype=int)
    places: wp.array(dtype=wp.vec3)
    owners: wp.array(dtype=int)
    levels: wp.array(dtype=wp.uint8)
    owner_places: wp.array(dtype=wp.vec3)
    refused: wp.array(dtype=wp.uint8)


@wp.func
def box_number(slot: int, level: int, at: wp.vec3i) -> int:
    """Return the number of the box of a level, from 1 to LEVELS, that holds a cell of a block."""
    before = wp.where(level == 1, 0, wp.where(level == 2, 64, 72))
    side = 8 >> level
    return _BOXES * slot + before + (at[0] >> level) + side * ((at[1] >> level) + side * (at[2] >> level))


@wp.func
def word_of_box(corner: wp.vec3i, side: int) -> wp.uint64:
    """Return the word of a box's cells in one of its layers."""
    row = (wp.uint64((1 << side) - 1)) << wp.uint64(corner[0])
    word = NONE
    for y in range(side):
        word |= row << wp.uint64(8 * (corner[1] + y))
    return word


@wp.func
def state_of_half(words: CellWords, boxes: Boxes, slot: int, level: int, at: wp.vec3i) -> wp.uint8:
    """Return what a half of a box of a level is, a smaller box or a cell: of the ``states``."""
    if level > 1:
        return boxes.states[box_number(slot, level - 1, at)]
    layer = 8 * slot + at[2]
    one = wp.uint64(1) << wp.uint64(8 * at[1] + at[0])
    if (words.tame[layer] & one) != NONE:
        return _MERGED
    if (words.empty[layer] & one) != NONE:
        return _EMPTY
    return _NOT_MERGED


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
    along = 8 >> level
    slot = index // (along * along * along)
    box = index - slot * along * along * along
    corner = (1 << level) * wp.vec3i(box % along, (box // along) % along, box // (along * along))
    number = box_number(slot, level, corner)
    half = (1 << level) >> 1
    boxes.states[number] = _NOT_MERGED
    some = bool(False)
    for child in range(8):
        at = corner + half * wp.vec3i(child & 1, (child >> 1) & 1, child >> 2)
        state = state_of_half(words, boxes, slot, level, at)
        if state == _NOT_MERGED:
            return
        some = some or state == _MERGED
    if not some:
        boxes.states[number] = _EMPTY
        return
    if not is_disc(words.inside, grid.cells.upper, tables, slot, corner, half):
        return
    side = 2 * half
    word = word_of_box(corner, side)
    scale = 1.0 / float(side)
    squares = wp.mat33()
    right = wp.vec3()
    points = wp.vec3()
    count = float(0.0)
    lowest = int(-1)
    for z in range(side):
        layer = 8 * slot + corner[2] + z
        left = grid.cells.active[layer] & word
        while left != NONE:
            bit = lowest_bit(left)
            vertex = first_vertex(grid, layer, bit)
            if lowest < 0:
                lowest = vertex
            cell = wp.vec3(float((bit & 7) - corner[0]), float((bit >> 3) - corner[1]), float(z))
            point = scale * (cell + cell_places[vertex])
            normal = normals[vertex]
            squares += wp.outer(normal, normal)
            right += wp.dot(normal, point) * normal
            points += point
            count += 1.0
            left = left & (left - wp.uint64(1))
    best = nearest_point(grid.inset * scale, squares, right, points, count)
    error = float(0.0)
    for z in range(side):
        layer = 8 * slot + corner[2] + z
        left = grid.cells.active[layer] & word
        while left != NONE:
            bit = lowest_bit(left)
            vertex = first_vertex(grid, layer, bit)
            cell = wp.vec3(float((bit & 7) - corner[0]), float((bit >> 3) - corner[1]), float(z))
            off = wp.dot(normals[vertex], float(side) * best - cell - cell_places[vertex])
            error += off * off
            left = left & (left - wp.uint64(1))
    if error > flatness * flatness * count:
        return
    boxes.states[number] = _MERGED
    boxes.first[number] = lowest
    boxes.places[number] = float(side) * best


@wp.func
def level_at(boxes: Boxes, slot: int, at: wp.vec3i) -> int:
    """Return the level of the largest box that holds for a cell, 0 for none."""
    found = int(0)
    for level in range(1, _LEVELS + 1):
        if boxes.states[box_number(slot, level, at)] == _MERGED:
            found = level
    return found


@wp.kernel
def _find_owners(
    first: int, grid: DualGrid, words: CellWords, cell_places: wp.array(dtype=wp.vec3), boxes: Boxes
) -> None:
    layer = wp.tid() + first
    slot = layer >> 3
    left = words.tame[layer]
    while left != NONE:
        bit = lowest_bit(left)
        vertex = first_vertex(grid, layer, bit)
        at = wp.vec3i(bit & 7, bit >> 3, layer & 7)
        level = level_at(boxes, slot, at)
        boxes.levels[vertex] = wp.uint8(level)
        if level > 0:
            number = box_number(slot, level, at)
            boxes.owners[vertex] = boxes.first[number]
            boxes.owner_places[vertex] = boxes.places[number]
        else:
            boxes.owners[vertex] = vertex
            boxes.owner_places[vertex] = cell_places[vertex]
        left = left & (left - wp.uint64(1))


@wp.kernel
def _split(first: int, level: int, boxes: Boxes) -> None:
    # The boxes that hold are those whose first vertex is served by one of their own level.
    index = wp.tid() + first
    count = 512 >> (3 * level)
    slot = index // count
    before = wp.where(level == 1, 0, wp.where(level == 2, 64, 72))
    number = _BOXES * slot + before + index - slot * count
    if boxes.states[number] == _MERGED:
        lowest = boxes.first[number]
        if int(boxes.levels[lowest]) == level and boxes.refused[lowest] != wp.uint8(0):
            boxes.states[number] = _NOT_MERGED


@wp.kernel
def _write_vertices(
    first: int,
    grid: DualGrid,
    blocks: wp.array(dtype=wp.vec3i),
    voxel_size: float,
    boxes: Boxes,
    colors: wp.array(dtype=wp.vec3ub),
    normals: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
) -> None:
    number = wp.tid() + first
    slot = number // _BOXES
    box = number - _BOXES * slot
    level = wp.where(box < 64, 1, wp.where(box < 72, 2, 3))
    if boxes.states[number] != _MERGED or int(boxes.levels[boxes.first[number]]) != level:
        return
    own = box - wp.where(level == 1, 0, wp.where(level == 2, 64, 72))
    along = 8 >> level
    side = 1 << level
    corner = side * wp.vec3i(own % along, (own // along) % along, own // (along * along))
    word = word_of_box(corner, side)
    color = wp.vec4()
    normal = wp.vec3()
    for z in range(side):
        layer = 8 * slot + corner[2] + z
        left = grid.cells.active[layer] & word
        while left != NONE:
            vertex = first_vertex(grid, layer, lowest_bit(left))
            some = colors[vertex]
            color += wp.vec4(float(some[0]), float(some[1]), float(some[2]), 1.0)
            normal += normals[vertex]
            left = left & (left - wp.uint64(1))
    lattice = 8 * blocks[number_of(grid.cells, slot)] + corner
    place = wp.vec3(float(lattice[0]), float(lattice[1]), float(lattice[2])) + boxes.places[number]
    points[boxes.first[number]] = voxel_size * place
    colors[boxes.first[number]] = as_bytes(color)
    normals[boxes.first[number]] = wp.normalize(normal)


class BoxTree:
    """The boxes of a grid: found once, split one by one, and at last written."""

    def __init__(self, grid: DualGrid, places: wp.array, normals: wp.array, *, flatness: float) -> None:
        self.device: Any = places.device
        self.grid = grid
        self.places = places
        self.slots, self._vertices = len(grid.several) // 8, len(places)
        self.words = find_tame_cells(grid)
        self.boxes = boxes = Boxes()
        count = BOXES * self.slots
        boxes.states = wp.zeros(count, dtype=wp.uint8, device=self.device)
        boxes.first = wp.zeros(count, dtype=int, device=self.device)
        boxes.places = wp.zeros(count, dtype=wp.vec3, device=self.device)
        boxes.owners = wp.empty(self._vertices, dtype=int, device=self.device)
        boxes.levels = wp.zeros(self._vertices, dtype=wp.uint8, device=self.device)
        boxes.owner_places = wp.clone(places)
        boxes.refused = wp.zeros(self._vertices, dtype=wp.uint8, device=self.device)
        wp.launch(_count_up, dim=self._vertices, outputs=[boxes.owners], device=self.device)
        tables = cell_tables(str(self.device.alias))
        for level in range(1, LEVELS + 1):
            inputs = [level, grid, tables, self.words, places, normals, flatness]
            dim = self.slots * (512 >> (3 * level))
            launch_over_layers(_merge, dim=dim, inputs=inputs, outputs=[boxes], device=self.device)
        self._find_owners()

    def split_refused(self) -> None:
        """Split the boxes whose owners are ``refused``, and forget these."""
        for level in range(1, LEVELS + 1):
            dim = self.slots * (512 >> (3 * level))
            launch_over_layers(_split, dim=dim, inputs=[level], outputs=[self.boxes], device=self.device)
        self.boxes.refused.zero_()
        self._find_owners()

    def write(self, volume: Volume, cells: Vertices) -> None:
        """Write the boxes' vertices in the place of the first of their ``cells``' each."""
        launch_over_layers(
            _write_vertices,
            dim=BOXES * self.slots,
            inputs=[self.grid, volume.table.blocks, volume.voxel_size, self.boxes],
            outputs=[cells.colors, cells.normals, cells.points],
            device=self.device,
        )

    def _find_owners(self) -> None:
        inputs = [self.grid, self.words, self.places]
        dim = len(self.grid.several)
        launch_over_layers(_find_owners, dim=dim, inputs=inputs, outputs=[self.boxes], device=self.device)


@wp.kernel
def _count_up(numbers: wp.array(dtype=int)) -> None:
    numbers[wp.tid()] = wp.tid()
