"""The volume as an OpenVDB file, which Blender and other 3D tools open: grids ``distance`` and ``color``.

``distance`` holds metres, positive outside, truncated; its background is the truncation. ``color`` holds linear RGB
from 0 to 1, as shaders take it. Voxel i lies at i · voxel size in the world frame. Voxels that were never seen, or have
no colour, are inactive; a tool that makes no difference between active and inactive finds a second surface where the
observed band ends behind the first, which ``mesh.ply`` does not have.

OpenVDB's Python module is in no package index by itself; it comes with Blender as a module (``bpy``), from which it is
loaded here without Blender.
"""

import importlib.util
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.atomic_write import replacing
from datagen.color import linear_from_srgb
from datagen.errors import InputError
from fusion.devices import launch_in_slabs
from fusion.volume.block_table import BLOCK_SIDE, BLOCK_VOXELS
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxels import Voxels, distance_of, sums_of, weight_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_ABSENT = wp.constant(-8.0)
"""Marks what a voxel does not have: no average distance (in truncations) or colour comes near."""


@wp.kernel
def _average(
    first: int,
    voxels: Voxels,
    truncation: float,
    distance: wp.array(dtype=float),
    color: wp.array(dtype=wp.vec3),
) -> None:
    voxel = wp.tid() + first
    distance[voxel] = _ABSENT * truncation
    color[voxel] = wp.vec3(_ABSENT)
    if weight_of(voxels, voxel) > 0.0:
        distance[voxel] = truncation * distance_of(voxels, voxel)
        sums = sums_of(voxels, voxel)
        if sums.color_weight > 0.0:
            color[voxel] = sums.color / sums.color_weight


def write_vdb(path: Path, volume: Volume) -> None:
    """Write a volume as an OpenVDB file, atomically; raises InputError where OpenVDB is not at hand."""
    vdb = load_openvdb()
    distance, color = _averages(volume)
    origins = BLOCK_SIDE * volume.table.blocks.numpy()[: volume.table.count]
    # The marks as the grid holds them, in float32.
    absent = float(np.float32(_ABSENT) * np.float32(volume.truncation))
    distances = _filled(vdb.FloatGrid(absent), origins, distance, background=volume.truncation)
    colors = _filled(vdb.Vec3SGrid((_ABSENT,) * 3), origins, color, background=(0.0, 0.0, 0.0))
    distances.name, colors.name = "distance", "color"
    for grid in (distances, colors):
        grid.transform = vdb.createLinearTransform(voxelSize=volume.voxel_size)
    with replacing(path) as temporary:
        vdb.write(str(temporary), grids=[distances, colors])


def _averages(volume: Volume) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return each voxel's distance (n,), metres, and linear colour (n, 3), or the marks of what it does not have."""
    voxels = volume.table.count * BLOCK_VOXELS
    distance = wp.empty(voxels, dtype=float, device=volume.device)
    color = wp.empty(voxels, dtype=wp.vec3, device=volume.device)
    launch_in_slabs(
        _average,
        dim=voxels,
        inputs=[volume.voxels, volume.truncation],
        outputs=[distance, color],
        device=volume.device,
    )
    colors = color.numpy()
    colored = colors[:, 0] != _ABSENT
    colors[colored] = linear_from_srgb(colors[colored] / 255)
    return distance.numpy(), colors


def _filled(grid: Any, origins: NDArray[np.int32], values: NDArray[np.float32], *, background: Any) -> Any:
    """Fill a grid whose background marks absent values, block by block, and give it the background it is to have."""
    # OpenVDB's arrays are [x, y, z]; a block's voxels lie z slowest.
    tiles = values.reshape(len(origins), BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE, *values.shape[1:]).swapaxes(1, 3)
    for origin, tile in zip(origins.tolist(), tiles, strict=True):
        grid.copyFromArray(np.ascontiguousarray(tile), ijk=tuple(origin))
    # What equals the background is inactive, and follows when it changes.
    grid.background = background
    return grid


def load_openvdb() -> ModuleType:
    """Return the module ``openvdb``: an installed one, or else Blender's; raises InputError where there is neither."""
    if importlib.util.find_spec("openvdb") is not None:
        return importlib.import_module("openvdb")
    blender = importlib.util.find_spec("bpy")  # found, not imported
    for folder in (blender.submodule_search_locations or []) if blender else []:
        for path in sorted(Path(folder).glob("*/python/**/site-packages/openvdb*")):
            spec = importlib.util.spec_from_file_location("openvdb", path)
            if path.name.endswith(tuple(EXTENSION_SUFFIXES)) and spec is not None and spec.loader is not None:
                module = importlib.util.module_from_spec(spec)
                spec.loader.exec_module(module)
                return module
    raise InputError(
        "a .vdb file needs OpenVDB, which comes with Blender's Python module; pip install 'scanback[blender]'"
    )
