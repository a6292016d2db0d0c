"""Whether the camera's path keeps clear of what stands in the scene, and its subject in view.

Only objects whose bounding box the camera comes near are looked at closely, through Blender's bounding volume
hierarchy of their evaluated triangles, so that a path around an object costs nothing.
"""

from collections.abc import Iterator, Sequence

import bpy
import numpy as np
from mathutils import Vector
from mathutils.bvhtree import BVHTree
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.scene_spec.trajectory_settings import ShellTrajectory, Trajectory
from datagen.trajectory.path_faults import Box, Fault, default_subjects, describe_faults, view_faults
from datagen.trajectory.viewing import on_a_sphere

Array = NDArray[np.float64]

SURFACES = ("MESH", "CURVE", "SURFACE", "FONT", "META")
INSIDE_RAYS = 16
INSIDE_PART = 0.75
"""Of the rays from a point that must leave through an odd number of surfaces for it to be inside: a mesh with a few
holes has an inside, too, but a sheet, which half of the rays meet, has none."""
STEP_PAST_HIT = 2e-6
"""How far behind a surface the same ray looks for the next one, in metres and in parts of the coordinates' size, which
are in single precision."""


def check_path(path: Array, settings: Trajectory, camera: PinholeCamera, *, clip_range: tuple[float, float]) -> None:
    """Raise InputError naming the frames in which the camera enters or touches an object, or loses its subject.

    ``path`` is world_from_camera (N, 4, 4). Objects are taken as they stand at Blender's current frame.
    """
    boxes = [box for _, box in _surfaces()]
    missing = sorted(set(settings.subject) - {box.name for box in boxes})
    if missing:
        there = ", ".join(sorted({box.name for box in boxes})) or "none"
        raise InputError(f"trajectory.subject: no object {missing[0]!r}; there are: {there}")
    clearance = settings.clearance if settings.clearance is not None else _near_corner(camera, clip_range[0])
    rooms = _box_of_all([box for box in boxes if box.name in settings.subject] or default_subjects(boxes, path))
    faults = []
    for instance, box in _surfaces():
        near, crossing = _close_frames(path[:, :3, 3], box.range_world, clearance)
        if isinstance(settings, ShellTrajectory):
            crossing = crossing[:0]  # from one random view to the next nothing moves
        if len(near) or len(crossing):
            tree = _tree(instance)
            is_room = rooms is not None and bool(
                (box.range_world[0] <= rooms[0]).all() and (box.range_world[1] >= rooms[1]).all()
            )
            faults += _faults_at(path[:, :3, 3], tree, box, near, crossing, clearance=clearance, may_be_room=is_room)
    faults += view_faults(boxes, path, camera, clip_range, subject=settings.subject, min_in_view=settings.min_in_view)
    if faults:
        raise InputError(describe_faults(faults))


def _surfaces() -> Iterator[tuple[bpy.types.DepsgraphObjectInstance, Box]]:
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
        yield instance, Box(name=thing.name, world_from_unit=world_from_unit)


def _near_corner(camera: PinholeCamera, clip_start: float) -> float:
    """Return how far the corners of the near plane are from the camera: nothing may be in what it cuts away."""
    x = max(camera.cx + 0.5, camera.width - 0.5 - camera.cx) / camera.fx
    y = max(camera.cy + 0.5, camera.height - 0.5 - camera.cy) / camera.fy
    return float(clip_start * np.sqrt(1 + x * x + y * y))


def _box_of_all(boxes: Sequence[Box]) -> Array | None:
    if not boxes:
        return None
    ranges = np.stack([box.range_world for box in boxes])
    return np.stack([ranges[:, 0].min(axis=0), ranges[:, 1].max(axis=0)])


def _close_frames(positions: Array, box_range: Array, clearance: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the frames in or near a box, and those whose way from the frame before may lead through it."""
    low, high = box_range[0] - clearance, box_range[1] + clearance
    near = ((positions >= low) & (positions <= high)).all(axis=1)
    before, after = positions[:-1], positions[1:]
    meets = ((np.minimum(before, after) <= high) & (np.maximum(before, after) >= low)).all(axis=1)
    return np.flatnonzero(near), np.flatnonzero(meets) + 1


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


def _faults_at(
    positions: Array,
    tree: BVHTree,
    box: Box,
    near: NDArray[np.intp],
    crossing: NDArray[np.intp],
    *,
    clearance: float,
    may_be_room: bool,
) -> list[Fault]:
    """Return in which frames the camera is inside an object, too near to it, or came through its surface."""
    inside = [int(i) for i in near if _is_inside(tree, positions[i])]
    if may_be_room and len(inside) == len(positions):
        inside = []  # a room or a sky around the whole scene
    distances = {int(i): _distance(tree, positions[i], clearance) for i in near if int(i) not in set(inside)}
    touching = [i for i, distance in distances.items() if distance < clearance]
    known = {*inside, *touching}
    through = [
        int(i)
        for i in crossing
        if not {int(i), int(i) - 1} & known and _is_crossed(tree, positions[i - 1], positions[i])
    ]
    faults = []
    if inside:
        faults.append(Fault(frames=tuple(inside), what=f"the camera is inside {box.name!r}"))
    if touching:
        nearest = min(distances[i] for i in touching)
        what = f"the camera is {nearest:.3g} m from {box.name!r}, at least {clearance:.3g} m is needed"
        faults.append(Fault(frames=tuple(touching), what=what))
    if through:
        faults.append(Fault(frames=tuple(through), what=f"on the way there the camera passes through {box.name!r}"))
    return faults


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
