"""Volumes fused from the frames of ``synthetic_scene``."""

import numpy as np
from synthetic_scene import CAMERA

from fusion.frames.frame_batch import FrameUploader
from fusion.integration.fuse_batch import find_batch_blocks, integrate_batch
from fusion.integration.options import Integration
from fusion.volume.block_table import BLOCK_VOXELS
from fusion.volume.tsdf_volume import Volume
from fusion.volume.volume_operations import to_storage

VOXEL_SIZE, TRUNCATION = 0.02, 0.07
PAPER = Integration()


def fuse(frames, device, options=PAPER, *, batch_size=32, order=None, blocks_of=None, storage="full"):
    """Integrate ``frames``, in batches, into the blocks that ``blocks_of`` (the same frames) touch."""
    volume = Volume(voxel_size=VOXEL_SIZE, truncation=TRUNCATION, device=device, max_blocks=10**5, storage=storage)
    upload = FrameUploader(CAMERA, device=device)
    for batch in batches(upload, blocks_of or frames, 32):
        find_batch_blocks(volume.table, batch, truncation=TRUNCATION, voxel_size=VOXEL_SIZE)
    volume.table.sort()
    volume.reserve(volume.table.count)
    for batch in batches(upload, [frames[i] for i in order] if order is not None else frames, batch_size):
        integrate_batch(volume, batch, options)
    return volume


def batches(upload, frames, size):
    for first in range(0, len(frames), size):
        some = frames[first : first + size]
        yield upload([f.depth for f in some], [f.world_from_camera for f in some], [f.color for f in some])


def by_block(volume):
    """Return {block coordinates: (512, 6) sums}."""
    count = volume.table.count
    arrays = to_storage(volume, "full").arrays()
    names = ("distance_sum", "weight", "color_sum", "color_weight")
    columns = [arrays[name].numpy()[: count * BLOCK_VOXELS].reshape(count, BLOCK_VOXELS, -1) for name in names]
    return dict(zip(map(tuple, volume.table.blocks.numpy()[:count].tolist()), np.concatenate(columns, 2), strict=True))
