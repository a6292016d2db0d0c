"""The signs of voxels that were not seen, as those of what was seen around them: behind a surface they are inside.

Voxels are seen to a truncation behind the surface alone. Boxes (``boxes``) reach farther, and what is true of their
corners has to be known there, too. No surface comes of it: cells are active where all of their corners were seen.
"""

import warp as wp

from fusion.surface.layers import (
    NONE,
    Cells,
    launch_over_layers,
    one_back_in_x,
    one_back_in_y,
    one_on_in_x,
    one_on_in_y,
    word_at,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

ROUNDS = 6
"""So many voxels far signs are extended: with four from the truncation more than a block."""


@wp.func
def beside(words: wp.array(dtype=wp.uint64), cells: Cells, layer: int) -> wp.uint64:
    """Return at each voxel of a layer whether something is true of one of the six beside it."""
    slot = layer >> 3
    z = layer & 7
    own = words[layer]
    found = one_on_in_x(own, word_at(words, cells.upper, slot, 1, z))
    found |= one_back_in_x(own, word_at(words, cells.lower, slot, 1, z))
    found |= one_on_in_y(own, word_at(words, cells.upper, slot, 2, z))
    found |= one_back_in_y(own, word_at(words, cells.lower, slot, 2, z))
    found |= word_at(words, cells.upper, slot, wp.where(z == 7, 4, 0), (z + 1) & 7)
    return found | word_at(words, cells.lower, slot, wp.where(z == 0, 4, 0), (z - 1) & 7)


@wp.kernel
def _extend(
    first: int,
    cells: Cells,
    known: wp.array(dtype=wp.uint64),
    inside: wp.array(dtype=wp.uint64),
    more_known: wp.array(dtype=wp.uint64),
    more_inside: wp.array(dtype=wp.uint64),
) -> None:
    layer = wp.tid() + first
    some = known[layer]
    also = beside(known, cells, layer) & ~some
    signs = inside[layer]
    if also != NONE:
        signs |= beside(inside, cells, layer) & also
    more_known[layer] = some | also
    more_inside[layer] = signs


def extended_signs(cells: Cells) -> tuple[wp.array, wp.array]:
    """Return by layers (n,) the voxels whose sign is known, and those that are inside."""
    known, inside = wp.clone(cells.seen), wp.clone(cells.inside)
    for _ in range(ROUNDS):
        more = wp.empty_like(known), wp.empty_like(inside)
        inputs = [cells, known, inside]
        launch_over_layers(_extend, dim=len(known), inputs=inputs, outputs=[*more], device=known.device)
        known, inside = more
    return known, inside
