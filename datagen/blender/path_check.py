"""Whether the camera's path keeps clear of what stands in the scene, and its subject in view.

Only objects whose bounding box the camera comes near are looked at closely, through Blender's bounding volume
hierarchy of their evaluated triangles, so that a path around an object costs nothing.
"""

from collections.abc import Iterator, Sequence, Set

import bpy
import numpy as np
from mathutils import Vector
from mathutils.bvhtree import BVHTree
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.scene_spec.trajectory_settings import Trajectory
from datagen.trajectory.camera_path import Way
from datagen.trajectory.path_faults import Box, Fault, default_subjects, describe_faults, view_faults
from datagen.trajectory.viewing import on_a_sphere

Array = NDArray[np.float64]
Leg = tuple[int, Array, Array]
"""A step of the camera's way: the frame that it leads to, where it begins and where it ends."""

SURFACES = ("MESH", "CURVE", "SURFACE", "FONT", "META")
INSIDE_RAYS = 16
INSIDE_PART = 0.75
"""Of the rays from a point that must leave through an odd number of surfaces for it to be inside: a mesh with a few
holes has an inside, too, but a sheet, which half of the rays meet, has none."""
STEP_PAST_HIT = 2e-6
"""How far behind a surface the same ray looks for the next one, in metres and in parts of the coordinates' size, which
are in single precision."""


def check_path(
    path: Array,
    way: Way | None,
    settings: Trajectory,
    camera: PinholeCamera,
    *,
    clip_range: tuple[float, float],
    names: Sequence[str] = (),
) -> None:
    """Raise InputError naming the frames in which the camera enters or touches an object, or loses its subject.

    ``path`` is world_from_camera (N, 4, 4), ``way`` how it gets from frame to frame, where that is known. Objects are
    taken as they stand at Blender's current frame; those with a pass index from 1 on have their name from ``names``.
    """
    boxes = [box for _, box in _surfaces(names)]
    missing = sorted(set(settings.subject) - {box.name for box in boxes})
    if missing:
        there = ", ".join(sorted({box.name for box in boxes})) or "none"
        raise InputError(f"trajectory.subject: no object {missing[0]!r}; there are: {there}")
    clearance = settings.clearance if settings.clearance is not None else _near_corner(camera, clip_range[0])
    seen = _range_of_all([box for box in boxes if box.name in settings.subject] or default_subjects(boxes, path))
    faults = []
    for instance, box in _surfaces(names):
        (low, high), positions = box.range_world, path[:, :3, 3]
        near = np.flatnonzero(((positions >= low - clearance) & (positions <= high + clearance)).all(axis=1))
        legs = _legs_near(way, low, high) if way is not None else []
        if len(near) or legs:
            tree = _tree(instance)
            is_around = seen is not None and bool(((low <= seen[0]) & (high >= seen[1])).all())
            found = _frame_faults(tree, box.name, positions, near, clearance=clearance, is_around=is_around)
            entered = {frame for fault in found for frame in fault.frames}
            faults += [*found, *_way_faults(tree, box.name, legs, entered)]
    faults += view_faults(boxes, path, camera, clip_range, subject=settings.subject, min_in_view=settings.min_in_view)
    if faults:
        raise InputError(describe_faults(faults))


def _surfaces(names: Sequence[str]) -> Iterator[tuple[bpy.types.DepsgraphObjectInstance, Box]]:
    """Yield what renders, and its bounding box; an instance is valid until the next one is asked for."""
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        thing = instance.object
        if thing.type not in SURFACES or thing.hide_render:
            continue
        corners = np.array(thing.bound_box, dtype=np.float64)
        low, size = corners.min(axis=0), np.ptp(corners, axis=0)
        object_from_unit = np.diag([*size, 1.0])
        object_from_unit[:3, 3] = low
        world_from_unit = np.array(instance.matrix_world, dtype=np.float64) @ object_from_unit
        # An object of several parts is several in Blender.
        name = names[thing.pass_index - 1] if 1 <= thing.pass_index <= len(names) else thing.name
        yield instance, Box(name=name, world_from_unit=world_from_unit)


def _near_corner(camera: PinholeCamera, clip_start: float) -> float:
    """Return how far the corners of the near plane are from the camera: nothing may be in what it cuts away."""
    x = max(camera.cx + 0.5, camera.width - 0.5 - camera.cx) / camera.fx
    y = max(camera.cy + 0.5, camera.height - 0.5 - camera.cy) / camera.fy
    return float(clip_start * np.sqrt(1 + x * x + y * y))


def _range_of_all(boxes: Sequence[Box]) -> Array | None:
    if not boxes:
        return None
    ranges = np.stack([box.range_world for box in boxes])
    return np.stack([ranges[:, 0].min(axis=0), ranges[:, 1].max(axis=0)])


def _legs_near(way: Way, low: Array, high: Array) -> list[Leg]:
    """Return those steps of the way that may lead through a box."""
    before, after = way.positions_world[:-1], way.positions_world[1:]
    meets = ((np.minimum(before, after) <= high) & (np.maximum(before, after) >= low)).all(axis=1)
    return [(int(np.ceil(way.frames[i + 1])), before[i], after[i]) for i in np.flatnonzero(meets)]


def _tree(instance: bpy.types.DepsgraphObjectInstance) -> BVHTree:
    mesh = instance.object.to_mesh()
    mesh.calc_loop_triangles()
    vertices = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.vertices.foreach_get("co", vertices.ravel())
    triangles = np.empty((len(mesh.loop_triangles), 3), np.int32)
    mesh.loop_triangles.foreach_get("vertices", triangles.ravel())
    instance.object.to_mesh_clear()
    world_from_object = np.array(instance.matrix_world, dtype=np.float64)
    vertices_world = vertices @ world_from_object[:3, :3].T + world_from_object[:3, 3]
    return BVHTree.FromPolygons(vertices_world.tolist(), triangles.tolist(), all_triangles=True)


def _frame_faults(
    tree: BVHTree, name: str, positions: Array, near: NDArray[np.intp], *, clearance: float, is_around: bool
) -> list[Fault]:
    """Return in which of the frames ``near`` an object the camera is inside it, or too close to it."""
    distances = {int(i): _distance(tree, positions[i], clearance) for i in near}
    touching = [i for i, distance in distances.items() if distance < clearance]
    inside = [i for i, distance in distances.items() if distance >= clearance and _is_inside(tree, positions[i])]
    if is_around and len(inside) + len(touching) == len(positions):
        inside = []  # a room or a sky around the whole scene
    faults = []
    if inside:
        faults.append(Fault(frames=tuple(inside), what=f"the camera is inside {name!r}"))
    if touching:
        nearest = min(distances[i] for i in touching)
        what = f"the camera is {nearest:.3g} m from {name!r}, at least {clearance:.3g} m is needed"
        faults.append(Fault(frames=tuple(touching), what=what))
    return faults


def _way_faults(tree: BVHTree, name: str, legs: Sequence[Leg], entered: Set[int]) -> list[Fault]:
    """Return on the way to which frames the camera passes through an object, where neither end is at fault itself."""
    through = {
        frame for frame, start, end in legs if not {frame - 1, frame} & entered and _is_crossed(tree, start, end)
    }
    what = f"on the way there the camera passes through {name!r}"
    return [Fault(frames=tuple(sorted(through)), what=what)] if through else []


def _distance(tree: BVHTree, position: Array, most: float) -> float:
    found = tree.find_nearest(Vector(position), most)[3]
    return float("inf") if found is None else float(found)


def _is_crossed(tree: BVHTree, start: Array, end: Array) -> bool:
    way = Vector(end - start)
    return way.length > 0 and tree.ray_cast(Vector(start), way.normalized(), way.length)[0] is not None


def _is_inside(tree: BVHTree, position: Array) -> bool:
    """Tell whether most rays from a point leave through an odd number of surfaces (Jordan's theorem)."""
    # Directions of a spiral by the golden angle, which align with no object's edges.
    steps = np.arange(INSIDE_RAYS)
    directions = on_a_sphere(
        (0, 0, 0), np.ones(INSIDE_RAYS), steps * np.pi * (3 - np.sqrt(5)) + 0.1, 1 - (2 * steps + 1) / INSIDE_RAYS
    )
    odd = sum(_surfaces_ahead(tree, Vector(position), Vector(direction)) % 2 for direction in directions)
    return odd >= INSIDE_PART * INSIDE_RAYS


def _surfaces_ahead(tree: BVHTree, origin: Vector, direction: Vector) -> int:
    count = 0
    while True:
        hit = tree.ray_cast(origin, direction)[0]
        if hit is None:
            return count
        count += 1
        origin = hit + direction * STEP_PAST_HIT * (1 + hit.length)
