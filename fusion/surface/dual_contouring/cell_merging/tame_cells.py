"""Which cells may be merged with others (``boxes``): those around which nothing is out of the ordinary.

A *tame* cell has one vertex and no ambiguous face, nor has any cell that touches it, and all of its crossed edges are
complete. So what needs vertices on faces, and the border of what was seen, stays with single cells.
"""

import warp as wp

from fusion.surface.dual_contouring.cell_merging.extended_signs import extended_signs
from fusion.surface.dual_contouring.dual_grid import DualGrid
from fusion.surface.dual_contouring.rim import rim_along
from fusion.surface.dual_contouring.several_loops import maybe_several
from fusion.surface.layers import NONE, corners_back, corners_on, launch_over_layers

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.struct
class CellWords:
    """By layers (n,): ``tame`` cells; ``empty`` ones, whose corners are on one side of the surface; and helpers.

    These are the voxels whose sign is ``known``, and those ``inside`` (``extended_signs``), ``odd`` cells, which may
    have several loops or an ambiguous face, those that touch one on their high side, ``near_odd``, and ``rim_x``,
    ``rim_y``, ``rim_z``, the voxels whose edge along an axis is at the rim.
    """

    known: wp.array(dtype=wp.uint64)
    inside: wp.array(dtype=wp.uint64)
    tame: wp.array(dtype=wp.uint64)
    empty: wp.array(dtype=wp.uint64)
    odd: wp.array(dtype=wp.uint64)
    near_odd: wp.array(dtype=wp.uint64)
    rim_x: wp.array(dtype=wp.uint64)
    rim_y: wp.array(dtype=wp.uint64)
    rim_z: wp.array(dtype=wp.uint64)


@wp.func
def any_of(words: wp.vec4ul) -> wp.uint64:
    """Return where one of four words is set."""
    return words[0] | words[1] | words[2] | words[3]


@wp.func
def all_of(words: wp.vec4ul) -> wp.uint64:
    """Return where all of four words are set."""
    return words[0] & words[1] & words[2] & words[3]


@wp.kernel
def _find_words(first: int, grid: DualGrid, words: CellWords) -> None:
    layer = wp.tid() + first
    slot = layer >> 3
    z = layer & 7
    cells = grid.cells
    low = corners_on(cells.inside, cells.upper, slot, z)
    high = corners_on(cells.inside, cells.upper, slot, z + 1)
    words.odd[layer] = cells.active[layer] & maybe_several(low, high)
    known = all_of(corners_on(words.known, cells.upper, slot, z))
    known &= all_of(corners_on(words.known, cells.upper, slot, z + 1))
    low = corners_on(words.inside, cells.upper, slot, z)
    high = corners_on(words.inside, cells.upper, slot, z + 1)
    on_one_side = (all_of(low) & all_of(high)) | ~(any_of(low) | any_of(high))
    words.empty[layer] = known & on_one_side
    x = NONE
    y = NONE
    z_edges = NONE
    if cells.starts[layer][0] != cells.starts[layer + 1][0]:
        x = rim_along(grid, layer, 0)
        y = rim_along(grid, layer, 1)
        z_edges = rim_along(grid, layer, 2)
    words.rim_x[layer] = x
    words.rim_y[layer] = y
    words.rim_z[layer] = z_edges


@wp.kernel
def _spread_up(first: int, grid: DualGrid, words: CellWords) -> None:
    layer = wp.tid() + first
    low = corners_on(words.odd, grid.cells.upper, layer >> 3, layer & 7)
    high = corners_on(words.odd, grid.cells.upper, layer >> 3, (layer & 7) + 1)
    words.near_odd[layer] = any_of(low) | any_of(high)


@wp.kernel
def _find_tame(first: int, grid: DualGrid, words: CellWords) -> None:
    layer = wp.tid() + first
    slot = layer >> 3
    z = layer & 7
    upper = grid.cells.upper
    wild = any_of(corners_back(words.near_odd, grid.cells.lower, slot, z))
    wild |= any_of(corners_back(words.near_odd, grid.cells.lower, slot, z - 1))
    for side in range(2):
        x = corners_on(words.rim_x, upper, slot, z + side)
        y = corners_on(words.rim_y, upper, slot, z + side)
        wild |= x[0] | x[2] | y[0] | y[1]
    wild |= any_of(corners_on(words.rim_z, upper, slot, z))
    words.tame[layer] = grid.cells.active[layer] & ~wild


def find_tame_cells(grid: DualGrid) -> CellWords:
    """Find which cells are tame and which are empty."""
    device, layers = grid.several.device, len(grid.several)
    words = CellWords()
    words.known, words.inside = extended_signs(grid.cells)
    for name in ("tame", "empty", "odd", "near_odd", "rim_x", "rim_y", "rim_z"):
        setattr(words, name, wp.empty(layers, dtype=wp.uint64, device=device))
    for kernel in (_find_words, _spread_up, _find_tame):
        launch_over_layers(kernel, dim=layers, inputs=[grid, words], outputs=[], device=device)
    return words
