"""The boxes that hold: found, split one by one, and at last written as vertices."""

from typing import Any

import warp as wp

from fusion.surface.dual_contouring.cell_merging.boxes import (
    BOXES,
    MERGED,
    NOT_MERGED,
    Boxes,
    box_number,
    boxes_before,
    corner_of_box,
    level_at,
    level_of_box,
    word_of_box,
)
from fusion.surface.dual_contouring.cell_merging.merge_boxes import merge_boxes
from fusion.surface.dual_contouring.cell_merging.tame_cells import CellWords, find_tame_cells
from fusion.surface.dual_contouring.dual_grid import DualGrid, first_vertex
from fusion.surface.dual_contouring.vertices import VertexArrays, Vertices, as_bytes
from fusion.surface.layers import NONE, launch_over_layers, lowest_bit, number_of
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_BOXES = wp.constant(BOXES)


@wp.kernel
def _find_owners(
    first: int, grid: DualGrid, words: CellWords, cell_places: wp.array(dtype=wp.vec3), boxes: Boxes
) -> None:
    layer = wp.tid() + first
    slot = layer >> 3
    if boxes.changed[slot] == wp.uint8(0):
        return
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
def _split(first: int, boxes: Boxes) -> None:
    # The boxes that hold are those whose first vertex is served by one of their own level.
    slot = wp.tid() + first
    changed = wp.uint8(0)
    for box in range(_BOXES):
        number = _BOXES * slot + box
        if boxes.states[number] == MERGED:
            lowest = boxes.first[number]
            if boxes.refused[lowest] != wp.uint8(0) and int(boxes.levels[lowest]) == level_of_box(box):
                boxes.states[number] = NOT_MERGED
                changed = wp.uint8(1)
    boxes.changed[slot] = changed


@wp.kernel
def _write_vertices(
    first: int,
    grid: DualGrid,
    blocks: wp.array(dtype=wp.vec3i),
    voxel_size: float,
    boxes: Boxes,
    cells: VertexArrays,
) -> None:
    number = wp.tid() + first
    slot = number // _BOXES
    box = number - _BOXES * slot
    level = level_of_box(box)
    if boxes.states[number] != MERGED or int(boxes.levels[boxes.first[number]]) != level:
        return
    corner = corner_of_box(level, box - boxes_before(level))
    side = 1 << level
    word = word_of_box(corner, side)
    color = wp.vec4()
    normal = wp.vec3()
    for z in range(side):
        layer = 8 * slot + corner[2] + z
        left = grid.cells.active[layer] & word
        while left != NONE:
            vertex = first_vertex(grid, layer, lowest_bit(left))
            some = cells.colors[vertex]
            color += wp.vec4(float(some[0]), float(some[1]), float(some[2]), 1.0)
            normal += cells.normals[vertex]
            left = left & (left - wp.uint64(1))
    lattice = 8 * blocks[number_of(grid.cells, slot)] + corner
    place = wp.vec3(float(lattice[0]), float(lattice[1]), float(lattice[2])) + boxes.places[number]
    cells.points[boxes.first[number]] = voxel_size * place
    cells.colors[boxes.first[number]] = as_bytes(color)
    cells.normals[boxes.first[number]] = wp.normalize(normal)


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
        boxes.changed = wp.full(self.slots, wp.uint8(1), dtype=wp.uint8, device=self.device)
        boxes.refused = wp.zeros(self._vertices, dtype=wp.uint8, device=self.device)
        wp.launch(_count_up, dim=self._vertices, outputs=[boxes.owners], device=self.device)
        merge_boxes(grid, self.words, places, normals, boxes, flatness=flatness)
        self._find_owners()

    def split_refused(self) -> None:
        """Split the boxes whose owners are ``refused``, and forget these."""
        launch_over_layers(_split, dim=self.slots, inputs=[], outputs=[self.boxes], device=self.device)
        self.boxes.refused.zero_()
        self._find_owners()

    def write(self, volume: Volume, cells: Vertices) -> None:
        """Write the boxes' vertices in the place of the first of their ``cells``' each."""
        launch_over_layers(
            _write_vertices,
            dim=BOXES * self.slots,
            inputs=[self.grid, volume.table.blocks, volume.voxel_size, self.boxes],
            outputs=[cells.arrays()],
            device=self.device,
        )

    def _find_owners(self) -> None:
        inputs = [self.grid, self.words, self.places]
        dim = len(self.grid.several)
        launch_over_layers(_find_owners, dim=dim, inputs=inputs, outputs=[self.boxes], device=self.device)


@wp.kernel
def _count_up(numbers: wp.array(dtype=int)) -> None:
    numbers[wp.tid()] = wp.tid()
