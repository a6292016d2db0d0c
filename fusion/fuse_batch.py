"""What happens to a batch of frames: its blocks are found, and then it is integrated."""

from dataclasses import replace

import numpy as np
import warp as wp
from numpy.typing import NDArray

from fusion.block_table import BlockTable
from fusion.color_confidence import lower_confidence_at_edges
from fusion.depth_tiles import depth_tiles
from fusion.find_blocks import find_blocks
from fusion.frame_batch import FrameBatch
from fusion.integrate import integrate_frames
from fusion.integration import Integration
from fusion.pixel_weights import pixel_weights
from fusion.visible_blocks import visible_blocks
from fusion.volume import Volume


def find_batch_blocks(
    table: BlockTable, batch: FrameBatch, *, truncation: float, voxel_size: float
) -> NDArray[np.int64]:
    """Enter the blocks of the batch's truncation bands; returns how many each frame added. See ``find_blocks``."""
    tiles = depth_tiles(batch, split_beyond=2 * truncation)
    return find_blocks(table, batch, tiles, truncation=truncation, voxel_size=voxel_size)


def integrate_batch(volume: Volume, batch: FrameBatch, options: Integration, *, remove: bool = False) -> wp.array:
    """Add a batch of frames to the blocks that they see, or take it away.

    Returns the frame masks (blocks, 4) of ``visible_blocks``: which quarters of which blocks were gone through.
    """
    tiles = depth_tiles(batch, split_beyond=2 * volume.truncation)
    lower_confidence_at_edges(batch, tiles, step=volume.truncation)
    weighed = replace(batch, pixel_weights=pixel_weights(batch, options.weighting, step=volume.truncation))
    masks = visible_blocks(volume, batch, tiles)
    integrate_frames(volume, weighed, masks, options, remove=remove)
    return masks
