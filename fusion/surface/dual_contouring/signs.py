"""Which voxels are inside, where an oracle knows better than the volume.

Averaged over frames, the distances that voxels store bulge at sharp edges: a frame that sees one side takes what lies
behind it for solid, though it may be outside the other. So an oracle is asked for the corners of all active cells, over
again until it was asked for those of the cells that became active thereby.
"""

from functools import cache
from typing import Any

import warp as wp

from fusion.devices import Kernel, launch_in_slabs
from fusion.surface.cells import find_crossings
from fusion.surface.dual_contouring.oracle import NOT_KNOWN, Oracle, is_known
from fusion.surface.layers import NONE, Cells, corners_back, lowest_bit, number_of
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

MOST_ROUNDS = 16
"""A bound: the surface moves by about a voxel a round, and by fewer voxels than the truncation has."""


@wp.func
def corners_of_active(cells: Cells, slot: int, z: int) -> wp.uint64:
    """Return the voxels of a layer that are corners of active cells."""
    here = corners_back(cells.active, cells.lower, slot, z)
    under = corners_back(cells.active, cells.lower, slot, z - 1)
    return here[0] | here[1] | here[2] | here[3] | under[0] | under[1] | under[2] | under[3]


@cache
def sign_kernel(value: Any, state_type: Any) -> Kernel:
    """Return the kernel that asks an oracle for the corners it was not asked for yet; a thread takes a layer."""

    @wp.kernel(module="unique", enable_backward=False, module_options={"max_unroll": 1})
    def ask_signs(
        first: int,
        cells: Cells,
        blocks: wp.array(dtype=wp.vec3i),
        state: state_type,
        asked: wp.array(dtype=wp.uint64),
        answers: wp.array(dtype=float),
        changes: wp.array(dtype=int),
    ) -> None:
        layer = wp.tid() + first
        changes[layer] = 0
        left = corners_of_active(cells, layer >> 3, layer & 7) & ~asked[layer]
        if left == NONE:
            return
        asked[layer] = asked[layer] | left
        number = number_of(cells, layer >> 3)
        corner = 8 * blocks[number]
        before = cells.inside[layer]
        inside = before
        while left != NONE:
            bit = lowest_bit(left)
            one = left & (~left + wp.uint64(1))
            point = wp.vec3(float(corner[0] + (bit & 7)), float(corner[1] + (bit >> 3)), float(corner[2] + (layer & 7)))
            answer = value(state, number, point)
            answers[64 * layer + bit] = answer
            if is_known(answer):
                inside = inside & ~one
                if answer < 0.0:
                    inside = inside | one
            left = left ^ one
        cells.inside[layer] = inside
        changes[layer] = wp.bit_count(before ^ inside)

    return ask_signs


def ask_signs(volume: Volume, cells: Cells, triangle_counts: wp.array, oracle: Oracle) -> wp.array:
    """Let the oracle say which corners of active cells are inside; unseen voxels stay unseen.

    Returns its answers by voxels, a layer's 64 after the other's; NOT_KNOWN also where it was not asked.
    """
    device, layers = volume.device, len(cells.inside)
    asked = wp.zeros(layers, dtype=wp.uint64, device=device)
    answers = wp.full(64 * layers, NOT_KNOWN, dtype=float, device=device)
    changes = wp.empty(layers, dtype=int, device=device)
    for _ in range(MOST_ROUNDS):
        launch_in_slabs(
            sign_kernel(oracle.value, oracle.state_type),
            dim=layers,
            inputs=[cells, volume.table.blocks, oracle.state],
            outputs=[asked, answers, changes],
            device=device,
            least_slab=64,
        )
        if not changes.numpy().any():
            break
        find_crossings(cells, triangle_counts)
    return answers
