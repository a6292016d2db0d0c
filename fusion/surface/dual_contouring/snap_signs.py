"""Voxels that the surface all but passes through are taken for outside, so that noise does not decide.

Where a plane lies in a plane of the lattice, the least noise makes it wander between the cells on both sides, and no
box holds all of it (``boxes``). Then the surface stays on the inner side, and where it would pass a little beyond a
voxel it passes beside it. Voxels beside unseen ones stay as they are: on the inner side there might be no cell.
"""

import copy

import warp as wp

from fusion.surface.cells import find_cells, find_crossings
from fusion.surface.dual_contouring.cell_merging.tame_cells import all_of
from fusion.surface.dual_contouring.oracle import is_known
from fusion.surface.dual_contouring.signs import corners_of_active
from fusion.surface.layers import NONE, Cells, corners_back, corners_on, launch_over_layers, lowest_bit, number_of
from fusion.volume.tsdf_volume import ARRAYS, Volume
from fusion.volume.voxels import Voxels, distance_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

MOST_SNAP = 0.01
"""Voxels: more than images without noise leave to chance."""
_JUST_OUTSIDE = wp.constant(1.0e-4)
"""Voxels."""
_LEAST_STEP = wp.constant(wp.uint64(1))
_DISTANCE_BITS = wp.constant(wp.uint64(0xFFFF))


@wp.kernel
def _find_seen_beyond(first: int, cells: Cells, seen_beyond: wp.array(dtype=wp.uint64)) -> None:
    layer = wp.tid() + first
    seen = all_of(corners_on(cells.seen, cells.upper, layer >> 3, layer & 7))
    seen_beyond[layer] = seen & all_of(corners_on(cells.seen, cells.upper, layer >> 3, (layer & 7) + 1))


@wp.func
def to_ask(cells: Cells, seen_beyond: wp.array(dtype=wp.uint64), layer: int) -> wp.uint64:
    """Return the inside voxels of a layer at active cells, all around which was seen."""
    slot = layer >> 3
    z = layer & 7
    surrounded = all_of(corners_back(seen_beyond, cells.lower, slot, z))
    surrounded &= all_of(corners_back(seen_beyond, cells.lower, slot, z - 1))
    return corners_of_active(cells, slot, z) & cells.inside[layer] & surrounded


@wp.kernel
def _snap_voxels(
    first: int,
    cells: Cells,
    seen_beyond: wp.array(dtype=wp.uint64),
    voxels_a_truncation: float,
    within: float,
    voxels: Voxels,
) -> None:
    layer = wp.tid() + first
    left = to_ask(cells, seen_beyond, layer)
    while left != NONE:
        voxel = 512 * number_of(cells, layer >> 3) + 64 * (layer & 7) + lowest_bit(left)
        if voxels_a_truncation * distance_of(voxels, voxel) > -within:
            if voxels.packed.shape[0] > 0:
                voxels.packed[voxel] = (voxels.packed[voxel] & ~_DISTANCE_BITS) | _LEAST_STEP
            else:
                voxels.distance_sum[voxel] = _JUST_OUTSIDE / voxels_a_truncation * voxels.weight[voxel]
        left = left & (left - wp.uint64(1))


@wp.kernel
def _snap_answers(
    first: int, cells: Cells, seen_beyond: wp.array(dtype=wp.uint64), within: float, answers: wp.array(dtype=float)
) -> None:
    layer = wp.tid() + first
    inside = cells.inside[layer]
    left = to_ask(cells, seen_beyond, layer)
    while left != NONE:
        one = left & (~left + wp.uint64(1))
        at = 64 * layer + lowest_bit(left)
        if is_known(answers[at]) and answers[at] > -within:
            inside = inside & ~one
            answers[at] = _JUST_OUTSIDE
        left = left ^ one
    cells.inside[layer] = inside


def _seen_beyond(cells: Cells) -> wp.array:
    """Return by layers (n,) the voxels that were seen, as was the next along each axis, and along several."""
    found = wp.empty_like(cells.seen)
    launch_over_layers(_find_seen_beyond, dim=len(found), inputs=[cells], outputs=[found], device=found.device)
    return found


def snapped(volume: Volume, *, min_weight: float, within: float) -> Volume:
    """Return a volume whose voxels ``within`` so many voxels under the surface are just outside it."""
    cells = find_cells(volume, wp.full(256, 1, dtype=int, device=volume.device), meshed=None, min_weight=min_weight)
    changed = copy.copy(volume)
    changed.voxels = Voxels()
    for name in ARRAYS["packed"] | ARRAYS["full"]:
        array = getattr(volume.voxels, name)
        copied = len(array) > 0 and name in ("packed", "distance_sum")
        setattr(changed.voxels, name, wp.clone(array) if copied else array)
    launch_over_layers(
        _snap_voxels,
        dim=len(cells.inside),
        inputs=[cells, _seen_beyond(cells), volume.truncation / volume.voxel_size, within],
        outputs=[changed.voxels],
        device=volume.device,
    )
    return changed


def snap_answers(cells: Cells, triangle_counts: wp.array, answers: wp.array, *, within: float) -> None:
    """Take those corners of active cells for outside that an oracle's ``answers`` have ``within`` so many voxels in."""
    inputs = [cells, _seen_beyond(cells), within]
    launch_over_layers(_snap_answers, dim=len(cells.inside), inputs=inputs, outputs=[answers], device=answers.device)
    find_crossings(cells, triangle_counts)
