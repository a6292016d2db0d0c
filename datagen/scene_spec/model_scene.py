"""A stage for a model that comes without a scene file: lights, sky and a path around it; or a .blend's own."""

import math
from pathlib import Path
from typing import Any

from datagen.scene_spec.measured_model import MeasuredModel, measure_model

CAMERA_DISTANCE = 4.2
"""In radii of the model's bounding sphere: it fills the height of an image that is taken with 50 mm."""
SUZANNES_RADIUS = 0.3
"""The stage is Suzanne's, made larger or smaller; irradiance stays as power grows with the square."""
STAGE_LIGHTS: tuple[dict[str, Any], ...] = (
    {"type": "area", "position": [-1.2, -1.4, 1.6], "color": "#fff1e0", "power": 42.0, "size": 1.2},
    {"type": "area", "position": [1.4, 1.2, 1.2], "color": "#dfeaff", "power": 20.0, "size": 1.0},
)
STAGE_WORLD = {"color": "#f2f4f6", "strength": 0.72}
KEYS_A_TURN, TURNS = 6, 2
ELEVATION_DEG = (22.0, 64.0, 22.0, -20.0)
"""From key to key, over and over: with six keys a turn the second one sees from below what the first saw from above."""
DEPTH_STEPS = 65_000
FINEST_DEPTH_SCALE = 0.0001


def scene_of_model(path: Path) -> dict[str, Any]:
    """Return the content of a scene file that shows the model file ``path``.

    A .blend brings its surfaces, lights, world, and its own camera with its motion where it has one. Anything else
    stands on a stage of its size, and the camera goes around it on two turns.
    """
    measured = measure_model(path)
    content: dict[str, Any] = {"name": path.stem[:63] or "model"}
    if path.suffix.lower() == ".blend":
        content["blend"] = {"file": str(path)}
        if measured.camera is not None:
            return content | own_camera(measured) | ({} if measured.is_lit else _lights(measured))
        lights = {} if measured.is_lit else _lights(measured)
    else:
        content["objects"] = [{"name": "model", "file": str(path)}]
        lights = _lights(measured)
    distance, unit = CAMERA_DISTANCE * measured.radius, measured.metres_per_unit
    farthest = distance + measured.radius
    return content | {
        "render": {"depth_scale": depth_scale_for(farthest, unit), "metres_per_unit": unit},
        "camera": {"clip_start": max(0.01 * distance, 1e-4), "clip_end": max(100 * distance, 1.0)},
        "keyframes": two_turns(measured.center, distance),
        **lights,
    }


def own_camera(measured: MeasuredModel) -> dict[str, Any]:
    """Return the parts of a scene file that show a .blend through its own camera, at its size and frame rate."""
    assert measured.camera is not None
    camera = dict(measured.camera)
    render = {key: camera.pop(key) for key in ("frames", "size", "frames_per_second")}
    render["metres_per_unit"] = unit = measured.metres_per_unit
    render["depth_scale"] = depth_scale_for(min(camera.pop("farthest"), camera["clip_end"]), unit)
    return {"render": render, "camera": camera, "trajectory": {"type": "blend-camera"}}


def depth_scale_for(farthest: float, metres_per_unit: float = 1.0) -> float:
    """Return metres a step, 1, 2 or 5 times a power of ten, at which a depth of ``farthest`` units fits 16 bits.

    It is no finer than ``FINEST_DEPTH_SCALE``, of a unit where that is shorter than a metre.
    """
    needed = max(farthest / DEPTH_STEPS * metres_per_unit, FINEST_DEPTH_SCALE * min(metres_per_unit, 1.0))
    power = 10.0 ** math.floor(math.log10(needed) + 1e-9)
    return float(f"{next(step * power for step in (1, 2, 5, 10) if step * power >= needed * (1 - 1e-9)):.1g}")


def two_turns(center: tuple[float, float, float], distance: float) -> list[dict[str, Any]]:
    """Return keyframes on two turns about the vertical through ``center``, all at one distance, seeing every side."""
    keys = []
    count = KEYS_A_TURN * TURNS
    for i in range(count + 1):
        azimuth = math.radians(-90 + 360 * i / KEYS_A_TURN)
        elevation = math.radians(ELEVATION_DEG[i % len(ELEVATION_DEG)])
        direction = (
            math.cos(azimuth) * math.cos(elevation),
            math.sin(azimuth) * math.cos(elevation),
            math.sin(elevation),
        )
        position = [c + distance * d for c, d in zip(center, direction, strict=True)]
        keys.append({"time": i / count, "position": position, "look_at": list(center)})
    return keys


def _lights(measured: MeasuredModel) -> dict[str, Any]:
    size = measured.radius / SUZANNES_RADIUS
    lights = [
        light
        | {
            "position": [c + size * p for c, p in zip(measured.center, light["position"], strict=True)],
            "look_at": list(measured.center),
            "power": light["power"] * size**2,
            "size": light["size"] * size,
        }
        for light in STAGE_LIGHTS
    ]
    return {"lights": lights, "world": STAGE_WORLD}
