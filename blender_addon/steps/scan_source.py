"""What is scanned, as files that a process of its own can render: a .blend and a scene file that names it."""

import contextlib
import itertools
import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..errors import ReconstructionError
from ..results.originals import kept_from_renders
from ..results.scene_collection import is_ours
from ..results.scene_units import metres_per_unit
from .evaluation import evaluated_as_shown

SURFACES = {"MESH", "CURVE", "SURFACE", "FONT", "META"}
FOCAL_LENGTH_MM, SENSOR_WIDTH_MM = 50.0, 36.0
FILLING = 0.9
"""Part of the image's height that the subject's bounding sphere takes."""
DEPTH_STEPS = 65_000
REACH, FARTHER = 64.0, 4.0
"""How far depth reaches along the camera's own path: so many units, or so many times what is in view now."""
STAGE_RADIUS = 0.3
"""The subject's radius for which the lights of the stage have the powers below."""
STAGE_LIGHTS = (((-1.2, -1.4, 1.6), "#fff1e0", 42.0, 1.2), ((1.4, 1.2, 1.2), "#dfeaff", 20.0, 1.0))
STAGE_WORLD = 'color = "#f2f4f6"\nstrength = 0.72'
BLEND_FILE, SCENE_FILE = "scene.blend", "scan.toml"


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """A sphere around a subject, and how far from its center the farthest thing in the scene is."""

    center: tuple[float, float, float]
    radius: float
    reach: float


def write_source(scene: bpy.types.Scene, active: Any, folder: Path, settings: dict[str, Any]) -> Path:
    """Write what is to be scanned into ``folder``, which nothing else is in, and return the scene file.

    ``settings`` are those of ``ScanProperties``; ``active`` is the active object. Raises ReconstructionError where
    there is nothing to scan, no camera to scan with, or no place to write to.
    """
    subject = _subject(scene, active, settings["subject"])
    if settings["trajectory"] == "CAMERA" and (scene.camera is None or scene.camera.type != "CAMERA"):
        raise ReconstructionError("The scene has no camera; add one, or choose another path than the active camera's")
    content = _scene_file(scene, subject, settings)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write_blend(scene, subject if settings["subject"] == "OBJECT" else None, folder / BLEND_FILE)
        (folder / SCENE_FILE).write_text(content, encoding="utf-8")
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or str(error).strip()
        raise ReconstructionError(f"{folder}: cannot be written ({reason}); choose another folder") from error
    return folder / SCENE_FILE


def _subject(scene: bpy.types.Scene, active: Any, kind: str) -> list[bpy.types.Object]:
    """Return the objects that are scanned, and for the active one all of its family, lights and empties too."""
    reason = why_nothing_to_scan(scene, active, kind)
    if reason is not None:
        raise ReconstructionError(reason)
    return [active, *active.children_recursive] if kind == "OBJECT" else scanned(scene, active, kind)


def scanned(scene: bpy.types.Scene, active: Any, kind: str) -> list[bpy.types.Object]:
    """Return the objects whose surfaces are scanned: of the active one and its children, or of the whole scene."""
    family = [active, *active.children_recursive] if kind == "OBJECT" else scene.objects
    kept = kept_from_renders(scene)
    return [item for item in family if _is_scanned(item, kept)]


def why_nothing_to_scan(scene: bpy.types.Scene, active: Any, kind: str) -> str | None:
    """Say why there is nothing to scan, None where there is something. It stops at the first surface: panels ask."""
    kept = kept_from_renders(scene)
    if kind != "OBJECT":
        there = any(_is_scanned(item, kept) for item in scene.objects)
        return None if there else "The scene has no object with a surface that renders; add one"
    if active is None:
        return "There is no active object; select one, or scan the whole scene"
    there = any(_is_scanned(item, kept) for item in (active, *active.children_recursive))
    return None if there else f"{active.name} has no surface that renders; select another object"


def _is_scanned(item: bpy.types.Object, kept: set[bpy.types.Object]) -> bool:
    """Tell whether an object is scanned; those ``kept`` from renders by their reconstruction are scanned again."""
    drawn = item.type in SURFACES or item.instance_type == "COLLECTION"
    return drawn and (not item.hide_render or item in kept) and not is_ours(item)


def bounds_of(objects: Iterable[bpy.types.Object], scene: bpy.types.Scene) -> Bounds:
    """Return the sphere around the selected ones of ``objects``, or around all, in the world frame."""
    every = [item for item in objects if item.type in SURFACES] or list(objects)
    chosen = [item for item in every if item.name in scene.view_layers[0].objects and item.select_get()] or every
    with evaluated_as_shown(every) as depsgraph:
        near, far = (np.concatenate([_points(item, depsgraph) for item in part]) for part in (chosen, every))
    center = (near.min(axis=0) + near.max(axis=0)) / 2
    radius = float(np.linalg.norm(near - center, axis=1).max())
    if radius <= 0:
        raise ReconstructionError(f"{chosen[0].name} has no extent; scan an object that has one")
    reach = float(np.linalg.norm(far - center, axis=1).max())
    return Bounds(center=tuple(center.tolist()), radius=radius, reach=reach)


def _points(item: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> NDArray[np.float64]:
    """Return points (N, 3) in the world whose hull an object fills: a mesh's vertices, or the corners of a box."""
    shown = item.evaluated_get(depsgraph)
    points = np.array([tuple(corner) for corner in shown.bound_box])
    if shown.type == "MESH" and len(shown.data.vertices):
        points = np.empty((len(shown.data.vertices), 3), np.float32)
        shown.data.vertices.foreach_get("co", points.ravel())
    world_from_object = np.array(shown.matrix_world)
    return points @ world_from_object[:3, :3].T + world_from_object[:3, 3]


def _scene_file(scene: bpy.types.Scene, subject: list[bpy.types.Object], settings: dict[str, Any]) -> str:
    size, unit = [settings["width"], settings["height"]], metres_per_unit(scene)
    render: dict[str, Any] = {
        "metres_per_unit": unit,
        "frames": settings["frames"],
        "size": size,
        "frames_per_second": scene.render.fps / scene.render.fps_base,
    }
    tables: dict[str, dict[str, Any]] = {
        "blend": {"file": BLEND_FILE, "lights": True, "world": settings["subject"] == "SCENE"}
    }
    bounds = bounds_of(subject, scene)
    if settings["trajectory"] == "CAMERA":
        trajectory: dict[str, Any] = {"type": "blend-camera"}
        render["depth_scale"] = _depth_step(max(REACH, FARTHER * _distance_now(scene.camera, bounds)) * unit)
    else:
        trajectory = _path(bounds, settings)
        distance = trajectory["radius"]
        render["depth_scale"] = _depth_step((distance + bounds.reach) * unit)
        tables["camera"] = {"clip_start": max(0.01 * distance, 1e-4), "clip_end": 10 * (distance + bounds.reach)}
    tables |= {"render": render, "trajectory": trajectory}
    lines = [f"name = {json.dumps(_plain(scene.name))}"]
    for name, table in tables.items():
        lines += ["", f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in table.items())]
    if settings["subject"] == "OBJECT" or not _is_lit(scene):
        lines += _stage(bounds)
    return "\n".join([*lines, ""])


def fitting_distance(scene: bpy.types.Scene, active: Any, kind: str, *, width: int, height: int) -> float:
    """Return how far from the subject's center a camera has it fill an image. Raises ReconstructionError for none."""
    return _fitting(bounds_of(_subject(scene, active, kind), scene).radius, width=width, height=height)


def _fitting(radius: float, *, width: int, height: int) -> float:
    half_height = SENSOR_WIDTH_MM / 2 / FOCAL_LENGTH_MM * min(height / width, 1.0)
    return radius / math.sin(math.atan(half_height)) / FILLING


def _distance_now(camera: bpy.types.Object, bounds: Bounds) -> float:
    """Return how far from the camera, where it is now, the farthest thing may be."""
    return float(np.linalg.norm(np.array(camera.matrix_world.translation) - bounds.center)) + bounds.reach


def _path(bounds: Bounds, settings: dict[str, Any]) -> dict[str, Any]:
    fitting = _fitting(bounds.radius, width=settings["width"], height=settings["height"])
    path = {"center": list(bounds.center), "radius": settings["distance"] or fitting}
    if settings["trajectory"] == "ORBIT":
        elevation = math.degrees(settings["elevation"])
        return {"type": "orbit", **path, "elevation_deg": elevation, "turns": settings["turns"]}
    return {"type": "hemisphere", **path, "elevation_deg": [0.0, 80.0]}


def _depth_step(farthest: float) -> float:
    """Return metres a step, 1, 2 or 5 times a power of ten, at which depths up to ``farthest`` fit 16 bits."""
    needed = farthest / DEPTH_STEPS
    power = 10.0 ** math.floor(math.log10(needed))
    return float(f"{next(step * power for step in (1, 2, 5, 10) if step * power >= needed):.1g}")


def _stage(bounds: Bounds) -> list[str]:
    size = bounds.radius / STAGE_RADIUS
    lines = ["", "[world]", STAGE_WORLD]
    for position, color, power, side in STAGE_LIGHTS:
        place = [c + size * p for c, p in zip(bounds.center, position, strict=True)]
        light: dict[str, Any] = {"type": "area", "position": place, "look_at": list(bounds.center), "color": color}
        light |= {"power": power * size**2, "size": side * size}
        lines += ["", "[[lights]]", *(f"{key} = {_toml(value)}" for key, value in light.items())]
    return lines


def _is_lit(scene: bpy.types.Scene) -> bool:
    if any(item.type == "LIGHT" and not item.hide_render for item in scene.objects):
        return True
    if scene.world is None or scene.world.node_tree is None:
        return False
    backgrounds = [node for node in scene.world.node_tree.nodes if node.type == "BACKGROUND"]
    return any(
        any(socket.is_linked for socket in node.inputs)
        or node.inputs["Strength"].default_value * max(node.inputs["Color"].default_value[:3]) > 0.1
        for node in backgrounds
    )


def _write_blend(scene: bpy.types.Scene, family: list[bpy.types.Object] | None, path: Path) -> None:
    """Write the scene, without what we put there, or a scene of ``family`` alone and the camera."""
    for item in scene.objects:
        if item.mode != "OBJECT":
            item.update_from_editmode()
    with _as_it_was_scanned(scene), _scene_of(scene, family) as written:
        bpy.data.libraries.write(str(path), {written}, path_remap="ABSOLUTE")


@contextlib.contextmanager
def _as_it_was_scanned(scene: bpy.types.Scene) -> Iterator[None]:
    """Have what an earlier reconstruction put into the scene render no more, and its originals in their place."""
    ours = [item for item in itertools.chain(bpy.data.objects, bpy.data.collections) if _hides(item)]
    originals = [item for item in kept_from_renders(scene) if item.hide_render]
    changes = [(item, True) for item in ours] + [(item, False) for item in originals]
    for item, hidden in changes:
        item.hide_render = hidden
    try:
        yield
    finally:
        for item, hidden in changes:
            item.hide_render = not hidden


def _hides(item: Any) -> bool:
    # The scan's own camera may be one of ours: cameras do not render.
    return is_ours(item) and not item.hide_render and item.library is None


@contextlib.contextmanager
def _scene_of(scene: bpy.types.Scene, family: list[bpy.types.Object] | None) -> Iterator[bpy.types.Scene]:
    if family is None:
        yield scene
        return
    alone = bpy.data.scenes.new(scene.name)
    try:
        for item in [*family, *([scene.camera] if scene.camera is not None else [])]:
            if item.name not in alone.collection.objects:
                alone.collection.objects.link(item)
        alone.camera = scene.camera
        alone.frame_start, alone.frame_end = scene.frame_start, scene.frame_end
        alone.unit_settings.system = scene.unit_settings.system
        alone.unit_settings.scale_length = scene.unit_settings.scale_length
        alone.render.fps, alone.render.fps_base = scene.render.fps, scene.render.fps_base
        alone.view_layers[0].update()  # Blender 5.2 crashes as it writes a scene that was never evaluated
        yield alone
    finally:
        bpy.data.scenes.remove(alone)


def _plain(name: str) -> str:
    return "".join(c if c.isprintable() else " " for c in name)[:63] or "scan"


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else repr(value)
