"""New volumes from old ones: merged, cropped, or in the other form of storage.

All three take each voxel of the new volume once, on the device, and add up what the old ones hold of it.
"""

import math
from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from datagen.errors import InputError
from fusion.devices import launch_in_slabs
from fusion.volume.block_table import BLOCK_SIDE, BLOCK_VOXELS, COORDINATE_LIMIT, find_block, in_morton_order
from fusion.volume.memory_budget import block_budget
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxels import Storage, Voxels, VoxelSums, set_sums, sums_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_VOXELS = wp.constant(BLOCK_VOXELS)

Box = tuple[NDArray[np.int64], NDArray[np.int64]]
"""The least and the greatest voxel coordinates (3,) along each axis, inclusive."""

_EVERYWHERE: Box = (np.full(3, -(1 << 30)), np.full(3, 1 << 30))


@wp.kernel
def _find_sources(
    first: int,
    blocks: wp.array(dtype=wp.vec3i),
    keys: wp.array(dtype=wp.int64),
    numbers: wp.array(dtype=int),
    sources: wp.array(dtype=int),
) -> None:
    number = wp.tid() + first
    sources[number] = find_block(keys, numbers, blocks[number])


@wp.kernel
def _add_up(
    first: int,
    volumes: wp.array(dtype=Voxels),
    sources: wp.array2d(dtype=int),
    blocks: wp.array(dtype=wp.vec3i),
    low: wp.vec3i,
    high: wp.vec3i,
    result: Voxels,
) -> None:
    voxel = wp.tid() + first
    number = voxel / _VOXELS
    local = voxel - number * _VOXELS
    position = 8 * blocks[number] + wp.vec3i(local & 7, (local >> 3) & 7, local >> 6)
    for axis in range(3):
        if position[axis] < low[axis] or position[axis] > high[axis]:
            return
    total = VoxelSums()
    for i in range(volumes.shape[0]):
        source = sources[i, number]
        if source >= 0:
            sums = sums_of(volumes[i], source * _VOXELS + local)
            total.distance += sums.distance
            total.weight += sums.weight
            total.color += sums.color
            total.color_weight += sums.color_weight
    set_sums(result, voxel, total)


def merge(volumes: Sequence[Volume]) -> Volume:
    """Return the sum of volumes of the same voxel size, truncation and device; packed where all of them are.

    In blocks that all of them have, this is what one pass over the frames of all would have given, to the rounding of
    the storage: float32's in full, and in packed that of one write (see ``voxels.py``) on top of what the volumes'
    own writes rounded. A frame changes only blocks that its volume has, though: of a block that another volume adds, it
    does not say that it saw through it. Raises InputError for volumes that do not fit together.
    """
    if not volumes:
        raise InputError("no volume was given to merge")
    first = volumes[0]
    for volume in volumes[1:]:
        for name, one, other in (
            ("voxel size", first.voxel_size, volume.voxel_size),
            ("truncation", first.truncation, volume.truncation),
        ):
            if not math.isclose(one, other, rel_tol=1e-6):
                raise InputError(
                    f"volumes of {name} {one:g} m and {other:g} m cannot be merged; "
                    "reconstruct them with the same --voxel-size and --truncation"
                )
        if volume.device != first.device:
            raise InputError(f"volumes on {first.device} and {volume.device} cannot be merged; load both on one")
    packed = all(volume.storage == "packed" for volume in volumes)
    blocks = _union([_blocks(volume) for volume in volumes])
    return _combine(volumes, blocks, storage="packed" if packed else "full", box=_EVERYWHERE)


def crop(volume: Volume, low: ArrayLike, high: ArrayLike) -> Volume:
    """Return the part of a volume whose voxels' centres lie from ``low`` to ``high`` (3,), metres in the world frame.

    The other voxels are unseen; blocks wholly outside are gone. Bounds may be infinite. Raises InputError for a box
    that is none, or that holds nothing of the volume.
    """
    corners = np.array([low, high], dtype=np.float64)
    if corners.shape != (2, 3) or np.isnan(corners).any() or not (corners[0] < corners[1]).all():
        raise InputError(f"{_box_text(low, high)}: expected three numbers each, every low one less than its high one")
    lattice = (corners / volume.voxel_size).clip(-(1 << 30), 1 << 30)
    box = (np.ceil(lattice[0]).astype(np.int64), np.floor(lattice[1]).astype(np.int64))
    blocks = _blocks(volume)
    inside = ((BLOCK_SIDE * blocks + BLOCK_SIDE - 1 >= box[0]) & (BLOCK_SIDE * blocks <= box[1])).all(axis=1)
    if not inside.any():
        extent = "it is empty"
        if len(blocks):
            side = BLOCK_SIDE * volume.voxel_size
            least, most = blocks.min(axis=0) * side, (blocks.max(axis=0) + 1) * side
            extent = f"it spans {least.round(3).tolist()} to {most.round(3).tolist()} m"
        raise InputError(f"{_box_text(low, high)}: nothing of the volume lies in this box; {extent}")
    return _combine([volume], blocks[inside], storage=volume.storage, box=box)


def to_storage(volume: Volume, storage: Storage) -> Volume:
    """Return a copy of a volume in a form of storage; from full to packed, each voxel is rounded once."""
    return _combine([volume], _blocks(volume), storage=storage, box=_EVERYWHERE)


def _blocks(volume: Volume) -> NDArray[np.int32]:
    return volume.table.blocks.numpy()[: volume.table.count]


def _union(lists: list[NDArray[np.int32]]) -> NDArray[np.int32]:
    """Return each block of any list once, in Morton order."""
    # As one number each, blocks are sorted much faster than as rows.
    fields = np.concatenate(lists).astype(np.int64) + COORDINATE_LIMIT
    side = 2 * COORDINATE_LIMIT
    keys = np.unique((fields[:, 0] * side + fields[:, 1]) * side + fields[:, 2])
    distinct = np.stack([keys // side**2, keys // side % side, keys % side], axis=-1) - COORDINATE_LIMIT
    return in_morton_order(distinct.astype(np.int32))


def _combine(volumes: Sequence[Volume], blocks: NDArray[np.int32], *, storage: Storage, box: Box) -> Volume:
    """Return a volume of these blocks whose voxels in the box hold the sums over ``volumes``."""
    device = volumes[0].device
    budget = block_budget(device, storage)
    if len(blocks) > budget:
        raise InputError(f"the new volume has {len(blocks):,} blocks, more than the {budget:,} that memory allows")
    result = Volume(
        voxel_size=volumes[0].voxel_size,
        truncation=volumes[0].truncation,
        device=device,
        max_blocks=len(blocks),
        storage=storage,
    )
    if not len(blocks):
        return result
    result.table.adopt(blocks)
    result.reserve(len(blocks))
    sources = wp.empty((len(volumes), len(blocks)), dtype=int, device=device)
    for i, volume in enumerate(volumes):
        launch_in_slabs(
            _find_sources,
            dim=len(blocks),
            inputs=[result.table.blocks, volume.table.keys, volume.table.numbers],
            outputs=[sources[i]],
            device=device,
        )
    launch_in_slabs(
        _add_up,
        dim=len(blocks) * BLOCK_VOXELS,
        inputs=[
            wp.array([volume.voxels for volume in volumes], dtype=Voxels, device=device),
            sources,
            result.table.blocks,
            wp.vec3i(*box[0].tolist()),
            wp.vec3i(*box[1].tolist()),
        ],
        outputs=[result.voxels],
        device=device,
    )
    return result


def _box_text(low: ArrayLike, high: ArrayLike) -> str:
    return f"low {np.asarray(low).tolist()}, high {np.asarray(high).tolist()} m"
