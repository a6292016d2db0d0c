"""How much work a fusion was: voxels that were gone through, and voxels that were seen."""

import warp as wp

from fusion.devices import launch_in_slabs
from fusion.volume.block_table import BLOCK_VOXELS
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxels import Voxels, weight_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_BLOCK_VOXELS = wp.constant(BLOCK_VOXELS)


@wp.kernel
def _count_frames(masks: wp.array2d(dtype=wp.uint32), total: wp.array(dtype=wp.int64)) -> None:
    block = wp.tid()
    count = int(0)
    parts = masks.shape[1]
    for part in range(parts):
        count += wp.bit_count(masks[block, part])
    if count > 0:
        wp.atomic_add(total, 0, wp.int64(count * (_BLOCK_VOXELS / parts)))


@wp.kernel
def _count_observed(first: int, voxels: Voxels, counts: wp.array(dtype=int)) -> None:
    block = wp.tid() + first
    count = int(0)
    for voxel in range(block * _BLOCK_VOXELS, (block + 1) * _BLOCK_VOXELS):
        if weight_of(voxels, voxel) > 0.0:
            count += 1
    counts[block] = count


class UpdateCounter:
    """Adds up the voxels that frames are integrated into, on the device, so that nobody waits for the sum."""

    def __init__(self, volume: Volume) -> None:
        self._total = wp.zeros(1, dtype=wp.int64, device=volume.device)

    def add(self, masks: wp.array) -> None:
        """Count the voxels that a batch's frame masks (blocks, parts of a block) mark, once a frame."""
        # One launch, not slabs: on the CPU that is one thread, so the sum needs no atomics there.
        wp.launch(_count_frames, dim=masks.shape[0], inputs=[masks], outputs=[self._total], device=masks.device)

    @property
    def updates(self) -> int:
        """How many voxels were gone through so far, once a frame."""
        return int(self._total.numpy()[0])


def count_observed(volume: Volume) -> int:
    """Return how many voxels of a volume have been seen at least once."""
    counts = wp.empty(volume.table.count, dtype=int, device=volume.device)
    launch_in_slabs(
        _count_observed, dim=volume.table.count, inputs=[volume.voxels], outputs=[counts], device=volume.device
    )
    return int(counts.numpy().sum(dtype="int64"))
