"""Cameras that see as the scan's camera did."""

import bpy

from ..files.reconstruction_files import Intrinsics
from .camera_conversion import set_intrinsics

CLIP_START = 0.01
CLIP_END = 1000.0
"""Where a scan is a few units large; farther where it is hundreds of units, nearer where it is hundredths."""


def new_scan_camera(name: str, intrinsics: Intrinsics, *, size: float) -> bpy.types.Object:
    """Return a new camera object with a scan's intrinsics, drawn ``size`` large, a small part of the scan's size.

    Lengths are in the scene's units.
    """
    data = bpy.data.cameras.new(name)
    set_intrinsics(data, intrinsics)
    large, small = max(1.0, size), min(1.0, 10 * size)
    data.clip_start, data.clip_end = CLIP_START * large * small, CLIP_END * large
    data.display_size = size
    return bpy.data.objects.new(name, data)
