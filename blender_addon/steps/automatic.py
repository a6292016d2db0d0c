"""Lengths that are chosen for the user while they are 0: what they amount to, where that is known."""

from collections.abc import Callable
from typing import Any

import bpy

from ..errors import ReconstructionError
from ..results.scene_units import metres_per_unit
from ..scan_folder import scan_folder
from .estimate import VOXELS_PER_TRUNCATION, known_estimate
from .fuse_source import dataset_of
from .scan_source import fitting_distance

FIRST_GUESS_M = {"voxel_size": 0.01, "truncation": 0.04, "depth_max": 5.0, "distance": 2.0, "limit": 0.01}
"""What a length begins with that somebody wants to choose while nothing is known of the data."""


def known_voxel_size(scene: bpy.types.Scene) -> float | None:
    """Return the voxel size that is chosen, or that suits the dataset where that was looked at; the scene's units."""
    settings = scene.scanback.fuse
    if settings.voxel_size > 0:
        return float(settings.voxel_size)
    estimate = known_estimate(dataset_of(scene, scan_folder(scene)))
    return None if estimate is None else estimate.voxel_size / metres_per_unit(scene)


def known_truncation(scene: bpy.types.Scene) -> float | None:
    """Return the truncation that goes with the voxel size, in the scene's units."""
    voxel_size = known_voxel_size(scene)
    return None if voxel_size is None else VOXELS_PER_TRUNCATION * voxel_size


def suggestion(name: str, scene: bpy.types.Scene, active: Any, *, limit_m: float | None) -> float:
    """Return what the length ``name`` amounts to, in the scene's units, or something to begin with.

    ``limit_m`` is that of the errors which are shown, where any are.
    """
    unit = metres_per_unit(scene)
    known: dict[str, Callable[[], float | None]] = {
        "voxel_size": lambda: known_voxel_size(scene),
        "truncation": lambda: known_truncation(scene),
        "distance": lambda: _distance(scene, active),
        "limit": lambda: None if limit_m is None else limit_m / unit,
    }
    found = known[name]() if name in known else None
    return FIRST_GUESS_M[name] / unit if found is None else found


def _distance(scene: bpy.types.Scene, active: Any) -> float | None:
    settings = scene.scanback.scan
    try:
        return fitting_distance(scene, active, settings.subject, width=settings.width, height=settings.height)
    except ReconstructionError:  # there is nothing yet whose distance could be told
        return None
