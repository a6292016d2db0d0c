"""The block-sparse TSDF volume: which blocks exist, and each voxel's weighted sums."""

import warp as wp

from fusion.block_table import BLOCK_VOXELS, BlockTable
from fusion.devices import Device

BYTES_PER_BLOCK = BLOCK_VOXELS * 6 * 4
"""Six float32 sums a voxel."""


class Volume:
    """A truncated signed distance field with colour, on one device.

    Voxel i's centre lies at i · ``voxel_size`` (metres, world frame). A voxel of block b, at (x, y, z) within it, has
    the index 512·b + 64·z + 8·y + x in four arrays of weighted sums: ``distance_sum`` (of t_d, in units of
    ``truncation``), ``weight``, ``color_sum`` (RGB, 0 to 255) and ``color_weight``. Sums and not averages, so that
    merging volumes is addition and removing a frame is subtraction. The average of a voxel of weight 0 is +1 and
    black: unseen.
    """

    def __init__(self, *, voxel_size: float, truncation: float, device: Device, max_blocks: int) -> None:
        self.voxel_size = voxel_size
        self.truncation = truncation
        self.device = device
        self.table = BlockTable(device=device, max_blocks=max_blocks)
        self._allocate(0)

    def _allocate(self, blocks: int) -> None:
        voxels = blocks * BLOCK_VOXELS
        self.distance_sum = wp.zeros(voxels, dtype=float, device=self.device)
        self.weight = wp.zeros(voxels, dtype=float, device=self.device)
        self.color_sum = wp.zeros(voxels, dtype=wp.vec3, device=self.device)
        self.color_weight = wp.zeros(voxels, dtype=float, device=self.device)

    def reserve(self, blocks: int) -> None:
        """Make room for the sums of ``blocks`` blocks, keeping those that are there."""
        held = self.weight.shape[0]
        if blocks * BLOCK_VOXELS <= held:
            return
        before = (self.distance_sum, self.weight, self.color_sum, self.color_weight)
        self._allocate(blocks)
        if held:
            after = (self.distance_sum, self.weight, self.color_sum, self.color_weight)
            for target, source in zip(after, before, strict=True):
                wp.copy(target, source, count=held)
