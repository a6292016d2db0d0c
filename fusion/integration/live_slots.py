"""What a live volume keeps of a frame on its way in, and what it has to know once the frame is there."""

from dataclasses import dataclass
from typing import Any

import warp as wp

from fusion.devices import Device
from fusion.frames.frame_batch import FrameBatch, FrameUploader
from fusion.volume.block_table import TABLE_FULL, BlockArrays

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_TABLE_FULL = wp.constant(TABLE_FULL)


@wp.kernel
def _sum_up(answers: wp.array(dtype=int), table: BlockArrays, outcome: wp.array(dtype=int)) -> None:
    # outcome: what stood in the way, and how many blocks there are.
    index = wp.tid()
    room = table.blocks.shape[0]
    if answers[index] != 0:
        wp.atomic_max(outcome, 0, answers[index])
    if index == 0:
        outcome[1] = wp.min(table.count[0], room)
        if table.count[0] > room:
            # Another frame claimed what it was given no room for, and this one may have found that present.
            wp.atomic_max(outcome, 0, _TABLE_FULL)


@wp.kernel
def _note_changes(masks: wp.array2d(dtype=wp.uint32), changed: wp.array(dtype=wp.uint8)) -> None:
    number = wp.tid()
    for part in range(masks.shape[1]):
        if masks[number, part] != wp.uint32(0):
            changed[number] = wp.uint8(1)


@dataclass(kw_only=True)
class LiveSlot:
    """One of two buffers for a frame on its way into the volume.

    ``outcome`` (2,) int is pinned: it tells what stood in the way and how many blocks there were.
    """

    upload: FrameUploader
    outcome: wp.array
    done: Any = None
    batch: FrameBatch | None = None
    frame_id: int | None = None
    graph: Any = None


def note_outcome(answers: wp.array, table: BlockArrays, outcome: wp.array, *, device: Device) -> None:
    """Write into ``outcome`` (2,) int, on the device, what stood in the way of a frame's blocks, and their number."""
    outcome.zero_()
    wp.launch(_sum_up, dim=len(answers), inputs=[answers, table], outputs=[outcome], device=device)


def note_changes(masks: wp.array, changed: wp.array, *, blocks: int, device: Device) -> None:
    """Set ``changed`` (≥ blocks,) uint8 where a frame's ``masks`` (blocks, parts) say that it sees a block."""
    wp.launch(_note_changes, dim=blocks, inputs=[masks], outputs=[changed], device=device)
