"""Cameras that see as the scan's camera did."""

import bpy

from ..files.reconstruction_files import Intrinsics
from .camera_conversion import set_intrinsics

CLIP_START_M = 0.01
CLIP_END_M = 1000.0


def new_scan_camera(name: str, intrinsics: Intrinsics, *, size_m: float) -> bpy.types.Object:
    """Return a new camera object with a scan's intrinsics, drawn ``size_m`` large."""
    data = bpy.data.cameras.new(name)
    set_intrinsics(data, intrinsics)
    data.clip_start, data.clip_end = CLIP_START_M, CLIP_END_M
    data.display_size = size_m
    return bpy.data.objects.new(name, data)
