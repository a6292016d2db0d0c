"""A .blend's camera in the words of a scene file."""

import itertools
from collections.abc import Sequence
from typing import Any

import bpy
from mathutils import Vector

from datagen.blender.freeze import FIRST_FRAME, LAST_FRAME
from datagen.blender.trajectory import f_curves


def camera_settings(
    camera: bpy.types.Object, scene: bpy.types.Scene, low: Sequence[float], high: Sequence[float]
) -> dict[str, Any]:
    """Return the settings of a frozen camera, with ``frames``, ``size`` and ``frames_per_second`` of its ``scene``.

    ``farthest`` is the largest distance of the box from ``low`` to ``high`` from any of the camera's places.
    """
    data, render = camera.data, scene.render
    share = render.resolution_percentage / 100
    fit = data.sensor_fit.lower()
    return {
        "focal_length_mm": data.lens,
        "sensor_width_mm": data.sensor_width,
        "sensor_height_mm": data.sensor_height,
        "sensor_fit": fit,
        "shift_x": data.shift_x,
        "shift_y": data.shift_y,
        "pixel_aspect": render.pixel_aspect_x / render.pixel_aspect_y,
        "clip_start": max(data.clip_start, 1e-4),
        "clip_end": min(data.clip_end, 1e6),
        "frames": int(camera[LAST_FRAME]) - int(camera[FIRST_FRAME]) + 1,
        "size": [max(1, round(render.resolution_x * share)), max(1, round(render.resolution_y * share))],
        "frames_per_second": render.fps / render.fps_base,
        "farthest": _farthest(camera, low, high),
    }


def _farthest(camera: bpy.types.Object, low: Sequence[float], high: Sequence[float]) -> float:
    curves = sorted((c for c in f_curves(camera) if c.data_path == "location"), key=lambda curve: curve.array_index)
    places = [Vector([key.co[1] for key in keys]) for keys in zip(*(c.keyframe_points for c in curves), strict=True)]
    corners = [Vector(corner) for corner in itertools.product(*zip(low, high, strict=True))]
    return max((place - corner).length for place in places for corner in corners)
