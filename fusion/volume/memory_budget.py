"""How many blocks a volume may have."""

from fusion.devices import Device, free_memory
from fusion.volume.block_table import BLOCK_VOXELS
from fusion.volume.voxels import BYTES_PER_VOXEL, Storage

USABLE_SHARE = 0.7
"""How much of the free memory a volume may take; meshing needs some beside it."""

INDEX_LIMIT = (1 << 31) // BLOCK_VOXELS - 1
"""Voxels are indexed by 32-bit integers."""


def block_budget(device: Device, storage: Storage) -> int:
    """Return how many blocks a volume on ``device`` may have."""
    return min(int(USABLE_SHARE * free_memory(device) / bytes_per_block(storage)), INDEX_LIMIT)


def bytes_per_block(storage: Storage) -> int:
    """Return what a block's voxels take."""
    return BLOCK_VOXELS * BYTES_PER_VOXEL[storage]
