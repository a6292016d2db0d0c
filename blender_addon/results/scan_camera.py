"""Cameras that see as the scan's camera did."""

import bpy

from ..files.reconstruction_files import Intrinsics
from .camera_conversion import set_intrinsics

CLIP_START_M = 0.01
CLIP_END_M = 1000.0
"""Where a scan is a few metres large; farther where it is hundreds of units, nearer where it is hundredths."""


def new_scan_camera(name: str, intrinsics: Intrinsics, *, size_m: float) -> bpy.types.Object:
    """Return a new camera object with a scan's intrinsics, drawn ``size_m`` large, a small part of the scan's size."""
    data = bpy.data.cameras.new(name)
    set_intrinsics(data, intrinsics)
    large, small = max(1.0, size_m), min(1.0, 10 * size_m)
    data.clip_start, data.clip_end = CLIP_START_M * large * small, CLIP_END_M * large
    data.display_size = size_m
    return bpy.data.objects.new(name, data)
