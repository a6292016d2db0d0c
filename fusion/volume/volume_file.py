"""Volumes on disk: a zip of plain arrays (NumPy's .npz, read without pickle).

Version 2 holds ``version`` (), ``storage`` () "packed" or "full", ``voxel_size`` () and ``truncation`` () in metres,
``blocks`` (n, 3) int32, and for the 512 n voxels, in the order that ``Volume`` describes, the arrays of that storage:
``packed`` (512 n) uint64, laid out as ``voxels.py`` describes; or, all float32, ``distance_sum``, ``weight``,
``color_weight`` (512 n) and ``color_sum`` (512 n, 3). The zip's checksums tell a damaged file.
"""

import zipfile
import zlib
from pathlib import Path

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.atomic_write import replacing
from datagen.errors import InputError
from fusion.devices import Device
from fusion.volume.block_table import BLOCK_VOXELS, COORDINATE_LIMIT
from fusion.volume.tsdf_volume import ARRAYS, Volume
from fusion.volume.voxels import Storage

VERSION = 2

_UNREADABLE = (
    *(OSError, EOFError, KeyError, AttributeError, ValueError, TypeError, MemoryError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error),
)
"""What NumPy and zipfile raise for files that are damaged, or none of ours."""


def save_volume(path: Path, volume: Volume) -> None:
    """Write a volume atomically."""
    count = volume.table.count
    arrays = {name: array.numpy()[: count * BLOCK_VOXELS] for name, array in volume.arrays().items()}
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            version=VERSION,
            storage=volume.storage,
            voxel_size=volume.voxel_size,
            truncation=volume.truncation,
            blocks=volume.table.blocks.numpy()[:count],
            **arrays,
        )


def load_volume(path: Path, *, device: Device) -> Volume:
    """Read a volume; raises InputError where the file is missing, damaged, or of another version."""
    try:
        # Opened here, since NumPy leaves a file that it cannot read open.
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        version = int(arrays["version"])
        if version != VERSION:
            raise InputError(f"{path}: a volume of version {version}, expected {VERSION}; reconstruct it again")
        blocks = arrays["blocks"].astype(np.int32).reshape(-1, 3)
        volume = Volume(
            voxel_size=float(arrays["voxel_size"]),
            truncation=float(arrays["truncation"]),
            device=device,
            max_blocks=len(blocks),
            storage=_storage(str(arrays["storage"])),
        )
        _check(volume, arrays["blocks"], blocks)
        sums = {name: _voxels(arrays.pop(name), dtype, len(blocks)) for name, dtype in ARRAYS[volume.storage].items()}
    except FileNotFoundError:
        raise InputError(f"{path}: the file is missing; reconstruct it again") from None
    except _UNREADABLE as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: damaged, or not a volume ({error}); reconstruct it again") from error
    volume.table.adopt(blocks)
    for name, dtype in ARRAYS[volume.storage].items():
        # The arrays that were read become the volume's own, so that it is never in memory twice.
        setattr(volume.voxels, name, wp.array(sums.pop(name), dtype=dtype, device=device, copy=False))
    return volume


def _check(volume: Volume, stored: NDArray, blocks: NDArray[np.int32]) -> None:
    """Raise ValueError unless lengths and blocks are those of a volume."""
    for name, length in (("voxel_size", volume.voxel_size), ("truncation", volume.truncation)):
        if not 0 < length < np.inf:
            raise ValueError(f"{name} {length}")
    if stored.dtype.kind != "i":
        raise ValueError(f"blocks of type {stored.dtype}")
    if (np.abs(stored.astype(np.int64) + 0.5) > COORDINATE_LIMIT).any():
        raise ValueError("a block out of range")
    if len(np.unique(blocks, axis=0)) != len(blocks):
        raise ValueError("a block twice")


def _storage(name: str) -> Storage:
    if name not in ARRAYS:
        raise ValueError(f"unknown storage {name!r}")
    return name


def _voxels(array: NDArray, dtype: type, blocks: int) -> NDArray:
    """Return an array that was read in the shape and type that a volume takes."""
    if array.dtype.kind != ("u" if dtype is wp.uint64 else "f"):
        raise ValueError(f"voxels of type {array.dtype}")
    if dtype is wp.uint64:
        return array.astype(np.uint64, copy=False).reshape(blocks * BLOCK_VOXELS)
    tail = (3,) if dtype is wp.vec3 else ()
    return array.astype(np.float32, copy=False).reshape(blocks * BLOCK_VOXELS, *tail)
