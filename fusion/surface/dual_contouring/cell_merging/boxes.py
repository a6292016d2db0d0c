"""Boxes of 2, 4 and 8 cells a side, each within a block: where the surface is flat, one vertex serves a whole box.

A box takes the place of its eight halves where the surface in them is a disc (``box_topology``), and where a point is
near to the planes through their cells' vertices: the one that is nearest to all of them becomes the box's vertex. The
largest such boxes hold, until one is split.
"""

import warp as wp

from fusion.surface.layers import NONE

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

LEVELS = 3
BOXES = 64 + 8 + 1
"""Of a block, of all levels."""
NOT_MERGED = wp.constant(wp.uint8(0))
MERGED = wp.constant(wp.uint8(1))
EMPTY = wp.constant(wp.uint8(2))
_BOXES = wp.constant(BOXES)
_LEVELS = wp.constant(LEVELS)


@wp.struct
class Boxes:
    """By boxes (BOXES · slots,): ``states``, the least number of their cells' vertices, and where their own vertex is.

    ``places`` are in voxels from the box's lowest corner. By vertices of cells (n,): the ``owners``, numbers of the
    vertices that take their place, the ``levels`` of the boxes that these serve, 0 for a cell, and where they are
    there, ``owner_places``; ``refused`` is set for owners whose box is to be split. By slots, ``changed`` is set where
    a box was split last.
    """

    states: wp.array(dtype=wp.uint8)
    first: wp.array(dtype=int)
    places: wp.array(dtype=wp.vec3)
    owners: wp.array(dtype=int)
    levels: wp.array(dtype=wp.uint8)
    owner_places: wp.array(dtype=wp.vec3)
    refused: wp.array(dtype=wp.uint8)
    changed: wp.array(dtype=wp.uint8)


@wp.func
def boxes_before(level: int) -> int:
    """Return how many boxes of lower levels a block has."""
    return wp.where(level == 1, 0, wp.where(level == 2, 64, 72))


@wp.func
def level_of_box(box: int) -> int:
    """Return the level of a block's box, from its number among all of them."""
    return wp.where(box < 64, 1, wp.where(box < 72, 2, 3))


@wp.func
def box_number(slot: int, level: int, at: wp.vec3i) -> int:
    """Return the number of the box of a level, from 1 to LEVELS, that holds a cell of a block."""
    along = 8 >> level
    return (
        _BOXES * slot + boxes_before(level) + (at[0] >> level) + along * ((at[1] >> level) + along * (at[2] >> level))
    )


@wp.func
def corner_of_box(level: int, box: int) -> wp.vec3i:
    """Return the lowest cell of a block's box, from its number among those of its level."""
    along = 8 >> level
    return (1 << level) * wp.vec3i(box % along, (box // along) % along, box // (along * along))


@wp.func
def level_at(boxes: Boxes, slot: int, at: wp.vec3i) -> int:
    """Return the level of the largest box that holds for a cell, 0 for none."""
    found = int(0)
    for level in range(1, _LEVELS + 1):
        if boxes.states[box_number(slot, level, at)] == MERGED:
            found = level
    return found


@wp.func
def word_of_box(corner: wp.vec3i, side: int) -> wp.uint64:
    """Return the word of a box's cells in one of its layers."""
    row = (wp.uint64((1 << side) - 1)) << wp.uint64(corner[0])
    word = NONE
    for y in range(side):
        word |= row << wp.uint64(8 * (corner[1] + y))
    return word
