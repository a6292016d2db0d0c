"""The block-sparse TSDF volume: which blocks exist, and each voxel's weighted sums."""

import warp as wp

from fusion.devices import Device
from fusion.volume.block_table import BLOCK_VOXELS, BlockTable
from fusion.volume.voxels import Storage, Voxels

ARRAYS: dict[Storage, dict[str, type]] = {
    "packed": {"packed": wp.uint64},
    "full": {"distance_sum": wp.float32, "weight": wp.float32, "color_sum": wp.vec3, "color_weight": wp.float32},
}
"""The arrays of ``Voxels`` that a form of storage uses, and their types."""


class Volume:
    """A truncated signed distance field with colour, on one device.

    Voxel i's centre lies at i · ``voxel_size`` (metres, world frame). A voxel of block b, at (x, y, z) within it, has
    the index 512·b + 64·z + 8·y + x in the arrays of ``voxels``, which hold weighted sums in the form ``storage``. Sums
    and not averages, so that merging volumes is addition and removing a frame is subtraction. A voxel of weight 0 is
    unseen; its average is +1 and black. ``capacity`` is the block table's first (a power of two).
    """

    def __init__(
        self,
        *,
        voxel_size: float,
        truncation: float,
        device: Device,
        max_blocks: int,
        storage: Storage = "full",
        capacity: int = 1 << 14,
    ) -> None:
        self.voxel_size = voxel_size
        self.truncation = truncation
        self.device = device
        self.storage = storage
        self.table = BlockTable(device=device, max_blocks=max_blocks, capacity=capacity)
        self.voxels = self._zeros(0)

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays that hold the sums, by name; they may be longer than the blocks ask for."""
        return {name: getattr(self.voxels, name) for name in ARRAYS[self.storage]}

    @property
    def reserved(self) -> int:
        """How many blocks there is room for."""
        return int(next(iter(self.arrays().values())).shape[0]) // BLOCK_VOXELS

    def reserve(self, blocks: int) -> None:
        """Make room for the sums of ``blocks`` blocks, keeping those that are there."""
        held = self.reserved * BLOCK_VOXELS
        if blocks <= self.reserved:
            return
        before = self.arrays()
        self.voxels = self._zeros(blocks)
        if held:
            for name, array in self.arrays().items():
                wp.copy(array, before[name], count=held)

    def _zeros(self, blocks: int) -> Voxels:
        voxels = Voxels()
        used = ARRAYS[self.storage]
        for name, dtype in (ARRAYS["packed"] | ARRAYS["full"]).items():
            size = blocks * BLOCK_VOXELS if name in used else 0
            setattr(voxels, name, wp.zeros(size, dtype=dtype, device=self.device))
        return voxels
