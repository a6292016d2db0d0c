"""Volumes from dense fields, in either form of storage."""

import itertools

import numpy as np
import warp as wp

from fusion.volume.tsdf_volume import ARRAYS, Volume
from fusion.volume.voxels import Voxels, set_sums, sums_of


@wp.kernel
def _store(full: Voxels, stored: Voxels):
    voxel = wp.tid()
    set_sums(stored, voxel, sums_of(full, voxel))


def volume_of(
    field, device, *, storage="full", weight=None, color=None, color_weight=None, voxel_size=1.0, first_block=(0, 0, 0)
):
    """Put a dense field (nx, ny, nz) into a volume, voxel (0, 0, 0) at the world's origin; padding is unseen.

    Packed voxels hold distances from −1 to 1, to 1/32767. ``first_block`` moves the field by blocks.
    """
    blocks = [-(-side // 8) for side in field.shape]
    padding = [(0, 8 * n - side) for n, side in zip(blocks, field.shape, strict=True)]
    weight = np.pad(np.ones(field.shape) if weight is None else weight, padding)
    color = np.pad(np.zeros((*field.shape, 3)) if color is None else color, [*padding, (0, 0)])

    known = weight if color_weight is None else weight * np.pad(color_weight, padding)

    def tile(array):
        """Into (blocks, 512): blocks in x, y, z order; within one z slowest, x fastest."""
        parts = array.reshape(blocks[0], 8, blocks[1], 8, blocks[2], 8, -1).transpose(0, 2, 4, 5, 3, 1, 6)
        return parts.reshape(-1, array.shape[3]) if array.ndim == 4 else parts.reshape(-1)

    volume = Volume(voxel_size=voxel_size, truncation=1.0, device=device, max_blocks=10**5, storage=storage)
    volume.table.adopt(np.array(list(itertools.product(*map(range, blocks))), np.int32) + np.int32(first_block))
    volume.reserve(volume.table.count)
    assert volume.reserved == volume.table.count
    tiled_weight = tile(weight)
    sums = {
        "distance_sum": tile(np.pad(field, padding)) * tiled_weight,
        "weight": tiled_weight,
        "color_sum": tile(color * known[..., None]),
        "color_weight": tile(known),
    }
    arrays = ARRAYS["full"]
    full = Voxels()
    full.packed = wp.zeros(0, dtype=wp.uint64, device=device)
    for name, values in sums.items():
        setattr(full, name, wp.array(values.astype(np.float32), dtype=arrays[name], device=device))
    wp.launch(_store, dim=len(tiled_weight), inputs=[full, volume.voxels], device=device)
    return volume


def lattice(size):
    return np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), -1).astype(float)


def closed_random_field(seed, size=20):
    """Noise of both signs, positive all around: its surface must be closed."""
    field = np.random.default_rng(seed).normal(size=(size,) * 3)
    field[[0, -1]], field[:, [0, -1]], field[:, :, [0, -1]] = 1, 1, 1
    return field
