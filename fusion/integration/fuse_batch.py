"""What happens to a batch of frames: its blocks are found, and then it is integrated."""

from dataclasses import replace

import warp as wp

from datagen.progress import ProgressReporter, silent
from fusion.devices import Device, Step, load_kernels
from fusion.frames import color_confidence, depth_tiles
from fusion.frames.depth_tiles import DepthTiles
from fusion.frames.frame_batch import FrameBatch
from fusion.frames.frame_matrices import frame_matrices
from fusion.integration import integrate, pixel_weights
from fusion.integration.find_blocks import find_blocks
from fusion.integration.options import Integration
from fusion.integration.visible_blocks import visible_blocks
from fusion.volume.block_table import BlockTable
from fusion.volume.tsdf_volume import Volume

KERNEL_MODULES = (
    "fusion.volume.block_table",
    "fusion.frames.frame_matrices",
    "fusion.integration.find_blocks",
    "fusion.frames.farthest_depths",
    "fusion.integration.visible_blocks",
)


def load_fusion_kernels(
    options: Integration, *, device: Device, depth_type: type = wp.uint16, progress: ProgressReporter = silent
) -> None:
    """Load all that fusing frames with ``options`` launches, so that no later call has to wait for the compiler."""
    weighted = options.weighting != "constant"
    kernels = [
        depth_tiles.kernel(depth_type),
        color_confidence.kernel(depth_type),
        integrate.kernel_for(depth_type, device, options, weighted=weighted),
        *([pixel_weights.kernel(depth_type)] if weighted else []),
    ]
    load_kernels(KERNEL_MODULES, kernels, device=device, progress=progress)


def survey_batch(batch: FrameBatch, *, truncation: float) -> DepthTiles:
    """Return the depth tiles that finding a batch's blocks and integrating it both go by."""
    return depth_tiles.depth_tiles(batch, split_beyond=2 * truncation)


def find_batch_blocks(table: BlockTable, batch: FrameBatch, *, truncation: float, voxel_size: float) -> DepthTiles:
    """Enter the blocks of the batch's truncation bands (see ``find_blocks``); returns its tiles, for integration."""
    tiles = survey_batch(batch, truncation=truncation)
    matrices = frame_matrices(batch, voxel_size)
    find_blocks(table, batch, tiles, matrices, truncation=truncation, voxel_size=voxel_size)
    return tiles


def integrate_batch(
    volume: Volume,
    batch: FrameBatch,
    options: Integration,
    *,
    remove: bool = False,
    tiles: DepthTiles | None = None,
    blocks: int | None = None,
    problem: wp.array | None = None,
) -> wp.array:
    """Add a batch of frames to the blocks that they see, or take it away.

    ``tiles`` are the batch's, where they are known already; only the first ``blocks`` blocks are gone through, if
    given. Nothing is added where ``problem[0]``, on the device, is not 0. Returns the frame masks (blocks, 4) of
    ``visible_blocks``: which parts of which blocks were gone through.
    """
    tiles = tiles or survey_batch(batch, truncation=volume.truncation)
    color_confidence.judge_colors(batch, step=volume.truncation)
    weights = pixel_weights.pixel_weights(batch, options.weighting, step=volume.truncation)
    matrices = frame_matrices(batch, volume.voxel_size)
    weighed = replace(batch, pixel_weights=weights)

    def integration(masks: wp.array) -> Step:
        return integrate.integration_step(volume, weighed, matrices, masks, options, remove=remove)

    return visible_blocks(
        volume.table,
        batch,
        tiles,
        matrices,
        truncation=volume.truncation,
        blocks=blocks,
        problem=problem,
        then=integration,
    )
