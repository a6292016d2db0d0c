"""Volumes whose every voxel holds a field known in closed form, without fusing any frame."""

import itertools

import numpy as np
import warp as wp

from fusion.volume.block_table import BLOCK_SIDE
from fusion.volume.tsdf_volume import Volume
from fusion.volume.volume_operations import to_storage

_Z, _Y, _X = np.meshgrid(*[np.arange(BLOCK_SIDE)] * 3, indexing="ij")
IN_BLOCK = np.stack([_X, _Y, _Z], axis=-1).reshape(-1, 3)
"""The voxels of a block (512, 3) in the order in which a volume stores them."""


def voxel_centres(volume):
    """Return the world positions (512 n, 3) of a volume's voxels, metres."""
    blocks = volume.table.blocks.numpy()[: volume.table.count]
    return (BLOCK_SIDE * blocks[:, None] + IN_BLOCK).reshape(-1, 3) * volume.voxel_size


def sphere(centre, radius):
    return lambda points: np.linalg.norm(points - centre, axis=-1) - radius


def analytic_volume(
    distance, low, high, *, device, voxel_size, truncation, storage="full", weight=None, color=None, color_weight=None
):
    """Fill the blocks between two corners (metres) that come within the truncation of the surface.

    ``distance``, ``weight``, ``color_weight`` and ``color`` take points (n, 3) in metres; without them the weight is 1
    and the colour grey.
    """
    side = BLOCK_SIDE * voxel_size
    ranges = [range(int(np.floor(a / side)), int(np.ceil(b / side))) for a, b in zip(low, high, strict=True)]
    blocks = np.array(list(itertools.product(*ranges)), np.int32)
    reach = truncation + side  # from a block's centre to a point at the truncation from one of its voxels
    blocks = blocks[np.abs(distance((blocks + 0.5) * side)) < reach]
    volume = Volume(voxel_size=voxel_size, truncation=truncation, device=device, max_blocks=len(blocks))
    volume.table.adopt(blocks)
    volume.reserve(len(blocks))
    points = voxel_centres(volume)
    weights = np.ones(len(points)) if weight is None else weight(points)
    color_weights = weights if color_weight is None else color_weight(points)
    colors = np.full(points.shape, 128.0) if color is None else color(points)
    fill(
        volume,
        distance_sum=np.clip(distance(points) / truncation, -1, 1) * weights,
        weight=weights,
        color_sum=colors * color_weights[:, None],
        color_weight=color_weights,
    )
    return volume if storage == "full" else to_storage(volume, storage)


def fill(volume, **sums):
    """Put sums by name into a volume stored in full."""
    for name, values in sums.items():
        array = volume.arrays()[name]
        wp.copy(array, wp.array(values.astype(np.float32), dtype=array.dtype, device=volume.device))
