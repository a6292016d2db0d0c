"""What is true of the faces of a layer's voxels, an axis to a word: those that are crossed, and that may need vertices.

The surface makes a curve through a crossed face, and two through an *ambiguous* one.
"""

import warp as wp

from fusion.devices import sum_before
from fusion.surface.dual_contouring.dual_grid import DualGrid
from fusion.surface.dual_contouring.several_loops import crossed_twice
from fusion.surface.layers import NONE, corners_back, corners_on, launch_over_layers, word_at

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def face_corners(low: wp.vec4ul, high: wp.vec4ul, axis: int) -> wp.vec4ul:
    """Return the words of a face's corners (u, v) = (0, 0), (1, 0), (0, 1), (1, 1)."""
    if axis == 0:
        return wp.vec4ul(low[0], low[2], high[0], high[2])
    if axis == 1:
        return wp.vec4ul(low[0], low[1], high[0], high[1])
    return low


@wp.func
def back_along(back: wp.vec4ul, under: wp.vec4ul, axis: int) -> wp.uint64:
    """Return what is true one back along an axis, from the words of this layer and the one under it."""
    if axis == 2:
        return under[0]
    return back[axis + 1]


@wp.func
def any_beside(back: wp.vec4ul, under: wp.vec4ul) -> bool:
    """Return whether something is true of any voxel of a layer, or of one beside it across a face."""
    return (back[0] | back[1] | back[2] | under[0]) != NONE


@wp.kernel
def _find_curves(first: int, grid: DualGrid) -> None:
    layer = wp.tid() + first
    slot = layer >> 3
    z = layer & 7
    cells = grid.cells
    active = corners_back(cells.active, cells.lower, slot, z)
    active_under = corners_back(cells.active, cells.lower, slot, z - 1)
    curves = int(0)
    if any_beside(active, active_under):
        low = corners_on(cells.inside, cells.upper, slot, z)
        high = corners_on(cells.inside, cells.upper, slot, z + 1)
        for axis in range(3):
            corners = face_corners(low, high, axis)
            some = corners[0] | corners[1] | corners[2] | corners[3]
            every = corners[0] & corners[1] & corners[2] & corners[3]
            faces = some & ~every & (active[0] | back_along(active, active_under, axis))
            twice = faces & crossed_twice(corners)
            grid.faces[layer, axis] = faces
            grid.ambiguous[layer, axis] = twice
            curves += wp.bit_count(faces) + wp.bit_count(twice)
    # Where there are none the words stay as they are: nothing reads them.
    grid.curve_starts[layer] = curves


def find_curves(grid: DualGrid) -> int:
    """Find the curves through faces (``faces``, ``ambiguous``, ``curve_starts``) and return how many there are."""
    device, layers = grid.faces.device, len(grid.faces)
    launch_over_layers(_find_curves, dim=layers, inputs=[], outputs=[grid], device=device)
    sum_before(grid.curve_starts)
    return int(grid.curve_starts[layers:].numpy()[0])


@wp.func
def may_be_delicate(grid: DualGrid, slot: int, z: int) -> bool:
    """Return whether a layer has ambiguous faces below its cells, or cells with several loops there or beside it."""
    layer = 8 * slot + z
    # The surface goes on through no face below a cell that is not active.
    if grid.cells.active[layer] == NONE:
        return False
    found = grid.twice[layer] | grid.several[layer]
    found |= word_at(grid.several, grid.cells.lower, slot, 1, z) | word_at(grid.several, grid.cells.lower, slot, 2, z)
    found |= word_at(grid.several, grid.cells.lower, slot, wp.where(z == 0, 4, 0), (z - 1) & 7)
    return found != NONE


@wp.struct
class LayerWords:
    """What tells of a layer's faces: words of its cells' corners, and of ``active`` and ``several`` here and beside."""

    low: wp.vec4ul
    high: wp.vec4ul
    active: wp.vec4ul
    active_under: wp.vec4ul
    several: wp.vec4ul
    several_under: wp.vec4ul


@wp.func
def layer_words(grid: DualGrid, slot: int, z: int) -> LayerWords:
    """Look up a layer's words."""
    words = LayerWords()
    words.low = corners_on(grid.cells.inside, grid.cells.upper, slot, z)
    words.high = corners_on(grid.cells.inside, grid.cells.upper, slot, z + 1)
    words.active = corners_back(grid.cells.active, grid.cells.lower, slot, z)
    words.active_under = corners_back(grid.cells.active, grid.cells.lower, slot, z - 1)
    words.several = corners_back(grid.several, grid.cells.lower, slot, z)
    words.several_under = corners_back(grid.several, grid.cells.lower, slot, z - 1)
    return words


@wp.func
def face_pattern(words: LayerWords, axis: int, bit: int) -> int:
    """Return which corners of the face across ``axis`` from a voxel are inside, as ``pattern_of`` does."""
    corners = face_corners(words.low, words.high, axis)
    pattern = int(0)
    for corner in range(4):
        pattern |= int((corners[corner] >> wp.uint64(bit)) & wp.uint64(1)) << corner
    return pattern


@wp.func
def delicate_curves(words: LayerWords, axis: int) -> wp.vec2ul:
    """Return the faces across an axis on whose curve 0 and 1 the surface may come too near to another sheet.

    These are ambiguous, or beside a cell with several loops; the surface goes on through them.
    """
    corners = face_corners(words.low, words.high, axis)
    twice = crossed_twice(corners)
    delicate = twice | words.several[0] | back_along(words.several, words.several_under, axis)
    through = delicate & words.active[0] & back_along(words.active, words.active_under, axis)
    some = corners[0] | corners[1] | corners[2] | corners[3]
    every = corners[0] & corners[1] & corners[2] & corners[3]
    return wp.vec2ul(through & some & ~every, through & twice)


@wp.func
def last_curves(words: LayerWords, axis: int) -> wp.vec2ul:
    """Return the faces across an axis on whose curve 0 and 1 the mesh ends: one of the cells beside was seen."""
    corners = face_corners(words.low, words.high, axis)
    ends = words.active[0] ^ back_along(words.active, words.active_under, axis)
    some = corners[0] | corners[1] | corners[2] | corners[3]
    every = corners[0] & corners[1] & corners[2] & corners[3]
    return wp.vec2ul(ends & some & ~every, ends & crossed_twice(corners))
