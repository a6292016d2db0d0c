"""Frame integration: a batch's frames go into every voxel of the blocks that they see.

A frame changes a voxel where the pixel in front of it has a valid depth and d ≥ −t: farther behind the surface than the
truncation nothing was seen, and the −1 of equation (2) would claim solid space there. In front, t_d is clipped to +1.
Colour is taken where |d| ≤ t, near the surface that shows it. Each frame's weight w_new is 1, or what ``Weighting``
says.
"""

import warp as wp

from fusion.devices import Device, Kernel, Step
from fusion.frames.frame_batch import FrameBatch
from fusion.frames.frame_matrices import FrameMatrices
from fusion.integration.options import Integration
from fusion.integration.voxel_kernel import Rules, frames_type, kernel
from fusion.volume.block_table import BLOCK_VOXELS
from fusion.volume.tsdf_volume import Volume


def kernel_for(depth_type: type, device: Device, options: Integration, *, weighted: bool) -> Kernel:
    """Return the kernel that integrates with ``options``; ``weighted`` tells that pixels have weights."""
    return kernel(
        depth_type,
        by_voxel=device.is_cuda,
        bilinear=options.depth_sampling == "bilinear",
        weighted=weighted,
        drop_off=options.drop_off,
    )


def threads_a_block(device: Device) -> int:
    """Return how many threads share a block in the kernel for a device."""
    return BLOCK_VOXELS if device.is_cuda else 1


def integration_step(
    volume: Volume,
    batch: FrameBatch,
    matrices: FrameMatrices,
    masks: wp.array,
    options: Integration,
    *,
    remove: bool = False,
) -> Step:
    """Return the step that adds a batch of frames to the sums of each block of the volume, or takes it away.

    It follows ``visible_blocks``, whose ``masks`` (blocks, 4) tell what the frames see of a block. Removing what was
    added with the same options leaves the sums as they were before, to rounding.
    """
    assert batch.color is not None, "integration takes frames with colour"
    frames = frames_type(batch.depth.dtype)()
    frames.depth = batch.depth
    frames.depth_scale = batch.depth_scale
    frames.color = batch.color
    frames.confidence = batch.confidence
    if batch.pixel_weights is not None:
        frames.pixel_weights = batch.pixel_weights
    frames.pixel_from_lattice = matrices.pixel_from_lattice
    rules = Rules()
    rules.truncation = volume.truncation
    rules.sign = -1.0 if remove else 1.0
    rules.weight_cap = options.weight_cap or 3.0e38
    return Step(
        kernel=kernel_for(batch.depth.dtype, volume.device, options, weighted=batch.pixel_weights is not None),
        inputs=[masks, volume.table.blocks, frames, rules],
        outputs=[volume.voxels],
        threads=threads_a_block(volume.device),
    )
