"""Voxels that the surface all but passes through are taken for outside, so that noise does not decide.

Where a plane lies in a plane of the lattice, the least noise makes it wander between the cells on both sides, and no
box holds all of it (``boxes``). Then the surface stays on the inner side, and where it would pass a little beyond a
voxel it passes beside it.
"""

import copy

import warp as wp

from fusion.surface.cells import find_crossings
from fusion.surface.dual_contouring.oracle import is_known
from fusion.surface.dual_contouring.signs import corners_of_active
from fusion.surface.layers import NONE, Cells, launch_over_layers, lowest_bit
from fusion.volume.block_table import BLOCK_VOXELS
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
def _snap_voxels(first: int, voxels_a_truncation: float, within: float, voxels: Voxels) -> None:
    voxel = wp.tid() + first
    distance = voxels_a_truncation * distance_of(voxels, voxel)
    if distance < 0.0 and distance > -within:
        if voxels.packed.shape[0] > 0:
            voxels.packed[voxel] = (voxels.packed[voxel] & ~_DISTANCE_BITS) | _LEAST_STEP
        else:
            voxels.distance_sum[voxel] = _JUST_OUTSIDE / voxels_a_truncation * voxels.weight[voxel]


def snapped(volume: Volume, *, within: float) -> Volume:
    """Return a volume whose voxels ``within`` so many voxels under the surface are just outside it."""
    changed = copy.copy(volume)
    changed.voxels = Voxels()
    for name in ARRAYS["packed"] | ARRAYS["full"]:
        array = getattr(volume.voxels, name)
        copied = len(array) > 0 and name in ("packed", "distance_sum")
        setattr(changed.voxels, name, wp.clone(array) if copied else array)
    launch_over_layers(
        _snap_voxels,
        dim=BLOCK_VOXELS * volume.table.count,
        inputs=[volume.truncation / volume.voxel_size, within],
        outputs=[changed.voxels],
        device=volume.device,
    )
    return changed


@wp.kernel
def _snap_answers(first: int, cells: Cells, within: float, answers: wp.array(dtype=float)) -> None:
    layer = wp.tid() + first
    inside = cells.inside[layer]
    left = corners_of_active(cells, layer >> 3, layer & 7) & inside
    while left != NONE:
        one = left & (~left + wp.uint64(1))
        at = 64 * layer + lowest_bit(left)
        if is_known(answers[at]) and answers[at] > -within:
            inside = inside & ~one
            answers[at] = _JUST_OUTSIDE
        left = left ^ one
    cells.inside[layer] = inside


def snap_answers(cells: Cells, triangle_counts: wp.array, answers: wp.array, *, within: float) -> None:
    """Take those corners of active cells for outside that an oracle's ``answers`` have ``within`` so many voxels in."""
    launch_over_layers(
        _snap_answers, dim=len(cells.inside), inputs=[cells, within], outputs=[answers], device=answers.device
    )
    find_crossings(cells, triangle_counts)
