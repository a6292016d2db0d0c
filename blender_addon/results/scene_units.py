"""Metres in files, Blender's units in a scene: lengths change from one to the other here, and are written in words."""

from collections.abc import Sequence
from dataclasses import replace

import bpy
import numpy as np

from ..files.ply_mesh import ColoredMesh
from ..files.reconstruction_files import FusedFrame, LocatedFrame, Pose, Reconstruction, Record

UNIT_KEY = "scanback_metres_per_unit"
"""Custom property of a reconstruction's collection: how many metres a unit was when it was put into the scene."""
_FIXED_UNITS = {
    "KILOMETERS": (1000.0, "km"),
    "CENTIMETERS": (0.01, "cm"),
    "MILLIMETERS": (0.001, "mm"),
    "MICROMETERS": (1e-6, "µm"),
    "MILES": (1609.344, "mi"),
    "INCHES": (0.0254, "in"),
    "THOU": (2.54e-5, "thou"),
}
"""Units that a scene insists on; metres and feet are what every scene begins with, and too long for errors."""


def metres_per_unit(scene: bpy.types.Scene) -> float:
    """Return how many metres a unit of the scene is; one where it has no system of units, as datagen takes it."""
    units = scene.unit_settings
    return 1.0 if units.system == "NONE" else float(f"{units.scale_length:.7g}")


def unit_of(collection: bpy.types.Collection) -> float:
    """Return how many metres a unit was when a reconstruction was put into its scene, whatever that says now."""
    return float(collection.get(UNIT_KEY, 1.0))


def length_text(scene: bpy.types.Scene, metres: float) -> str:
    """Return a length in words, in the unit that the scene's lengths are shown in."""
    units = scene.unit_settings
    if units.system == "NONE":
        return _three_digits(metres)
    if units.length_unit in _FIXED_UNITS:
        size, symbol = _FIXED_UNITS[units.length_unit]
        return f"{_three_digits(metres / size)} {symbol}"
    return str(bpy.utils.units.to_string(units.system, "LENGTH", float(f"{metres:.3g}"), precision=4))


def _three_digits(number: float) -> str:
    return f"{number:,.0f}" if abs(number) >= 100 else f"{number:.3g}"


def pose_in_metres(world_from_camera: Pose, unit: float) -> Pose:
    """Return a pose (4×4) of a scene whose unit is ``unit`` metres with its place in metres."""
    return _moved(world_from_camera, unit)


def frames_in_units(trajectory: Sequence[FusedFrame], unit: float) -> tuple[FusedFrame, ...]:
    """Return frames, whose places are in metres, in units of ``unit`` metres."""
    return tuple(replace(frame, world_from_camera=_moved(frame.world_from_camera, 1 / unit)) for frame in trajectory)


def mesh_in_units(mesh: ColoredMesh, unit: float) -> ColoredMesh:
    """Return a mesh, which is in metres, in units of ``unit`` metres."""
    if unit == 1:
        return mesh
    return replace(mesh, vertices_world=(mesh.vertices_world.astype(np.float64) / unit).astype(np.float32))


def record_in_units(record: Record, unit: float) -> Record:
    """Return a record, in whatever unit it is, in units of ``unit`` metres; what is named _m stays in metres."""
    ratio = unit / record.metres_per_unit
    if ratio == 1:
        return record
    located = tuple(_located_in_units(frame, ratio) for frame in record.located)
    trajectory = frames_in_units(record.trajectory, ratio)
    return replace(record, trajectory=trajectory, located=located, metres_per_unit=unit)


def reconstruction_in_units(reconstruction: Reconstruction, unit: float) -> Reconstruction:
    """Return a reconstruction, in whatever unit it is, with its mesh in units of ``unit`` metres."""
    moved = record_in_units(reconstruction, unit)
    assert isinstance(moved, Reconstruction), "replacing members keeps the class"
    return replace(moved, mesh=mesh_in_units(moved.mesh, unit / reconstruction.metres_per_unit))


def _located_in_units(frame: LocatedFrame, unit: float) -> LocatedFrame:
    refined = None if frame.refined is None else _moved(frame.refined, 1 / unit)
    return replace(frame, world_from_camera=_moved(frame.world_from_camera, 1 / unit), refined=refined)


def _moved(pose: Pose, factor: float) -> Pose:
    moved = pose.copy()
    moved[:3, 3] *= factor
    return moved
