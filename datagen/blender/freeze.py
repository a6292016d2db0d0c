"""A scene as it would be rendered at one frame, made of plain meshes that nothing moves any more.

Modifiers, instances, curves, texts, drivers and simulations are evaluated once, with the settings for renders: what
Cycles renders is what the ground truth has, in every frame.
"""

from collections.abc import Iterable
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from datagen.blender.materials import add_neutral_material, add_vertex_color_material
from datagen.blender.opaque import make_opaque
from datagen.blender.placement import place
from datagen.errors import InputError

FROZEN_INDEX, FROZEN_NAME = "scanback_index", "scanback_name"
"""Custom properties of a frozen object: its place among the objects by name, from 0, and the name it had."""
FIRST_FRAME, LAST_FRAME = "scanback_first_frame", "scanback_last_frame"
"""Custom properties of a frozen camera."""


def freeze_scene(scene: bpy.types.Scene, *, source: Path, frame: int | None = None) -> set[bpy.types.ID]:
    """Return new objects for all that ``scene`` would render at ``frame``, with its camera and world.

    Surfaces become meshes and materials opaque; lights keep their places; the camera keeps its motion over the scene's
    frame range, everything else stands still. Raises InputError, naming ``source``, for what has no surface, for
    vertices that are no numbers, and for what depth cannot be had of.
    """
    scene.frame_set(scene.frame_start if frame is None else frame)
    show_as_rendered(scene)
    camera = _frozen_camera(scene, source) if scene.camera is not None else None
    scene.frame_set(scene.frame_start if frame is None else frame)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    surfaces: list[tuple[str, bpy.types.Object]] = []
    lights: list[bpy.types.Object] = []
    meshes: dict[int, bpy.types.Mesh | None] = {}
    for instance in depsgraph.object_instances:
        thing = instance.object
        if thing.type == "LIGHT":
            lights.append(_new_object(thing.name, thing.original.data.copy(), instance.matrix_world))
        # Curves, texts and metaballs come a second time, as the meshes that they evaluate to.
        if thing.type != "MESH" or not instance.show_self:
            continue
        key = thing.data.as_pointer()
        if key not in meshes:
            meshes[key] = _frozen_mesh(thing, depsgraph, source)
        mesh = meshes[key]
        if mesh is not None:
            owner = instance.parent if instance.is_instance else thing
            surfaces.append((owner.name, _new_object(thing.name, mesh, instance.matrix_world)))
    if not surfaces:
        raise InputError(f"{source}: shows no surface; a mesh with faces is needed, and not hidden from renders")
    _number(surfaces)
    _dress(mesh for mesh in meshes.values() if mesh is not None)
    materials = {slot for _, surface in surfaces for slot in surface.data.materials if slot is not None}
    for material in materials:
        make_opaque(material, source)
    _hold_still([*materials, *(light.data for light in lights), scene.world])
    frozen = {surface for _, surface in surfaces} | set(lights) | {camera, scene.world}
    return frozen - {None}


def show_as_rendered(scene: bpy.types.Scene) -> None:
    """Make Blender evaluate for the viewport what it would for a render: visibility, modifiers, resolutions."""
    scene.render.use_simplify = False
    for collection in (*bpy.data.collections, scene.collection):
        collection.hide_viewport = collection.hide_render
    for layer in scene.view_layers:
        _show_layers(layer.layer_collection)
    for thing in bpy.data.objects:
        thing.hide_viewport = thing.hide_render
        if thing.name in bpy.context.view_layer.objects:
            thing.hide_set(False)
        for modifier in thing.modifiers:
            modifier.show_viewport = modifier.show_render
            if modifier.type in ("SUBSURF", "MULTIRES"):
                modifier.levels = modifier.render_levels
    for curve in bpy.data.curves:
        curve.resolution_u = curve.render_resolution_u or curve.resolution_u
        curve.resolution_v = curve.render_resolution_v or curve.resolution_v
    for ball in bpy.data.metaballs:
        ball.resolution = ball.render_resolution
    bpy.context.view_layer.update()


def _show_layers(layer: bpy.types.LayerCollection) -> None:
    layer.hide_viewport = False
    for child in layer.children:
        _show_layers(child)


def _frozen_mesh(thing: bpy.types.Object, depsgraph: bpy.types.Depsgraph, source: Path) -> bpy.types.Mesh | None:
    """Return what an evaluated object looks like as a new mesh with its materials, or None where it has no face."""
    mesh = bpy.data.meshes.new_from_object(thing, preserve_all_data_layers=True, depsgraph=depsgraph)
    if mesh is None or not len(mesh.polygons):
        return None
    points = np.empty(len(mesh.vertices) * 3, np.float32)
    mesh.vertices.foreach_get("co", points)
    if not np.isfinite(points).all():
        raise InputError(f"{source}: {thing.name} has vertices that are not finite numbers; repair it and export anew")
    for i, slot in enumerate(thing.material_slots):
        if i < len(mesh.materials) and slot.material is not None:
            mesh.materials[i] = slot.material.original
    return mesh


def _new_object(name: str, data: bpy.types.ID, matrix_world: Matrix) -> bpy.types.Object:
    thing = bpy.data.objects.new(name, data)
    thing[FROZEN_NAME] = name
    place(thing, matrix_world.copy())
    return thing


def _number(surfaces: list[tuple[str, bpy.types.Object]]) -> None:
    places = {name: i for i, name in enumerate(sorted({owner for owner, _ in surfaces}))}
    for owner, surface in surfaces:
        surface[FROZEN_INDEX], surface[FROZEN_NAME] = places[owner], owner


def _dress(meshes: Iterable[bpy.types.Mesh]) -> None:
    """Give meshes without a material one: that of their vertex colours, where they have some."""
    colored: dict[str, bpy.types.Material] = {}
    for mesh in meshes:
        if any(material is not None for material in mesh.materials):
            continue
        colors = mesh.color_attributes.active_color or next(iter(mesh.color_attributes), None)
        attribute = colors.name if colors is not None else ""
        if attribute not in colored:
            colored[attribute] = (
                add_vertex_color_material("vertex colours", attribute) if attribute else add_neutral_material()
            )
        mesh.materials.clear()
        mesh.materials.append(colored[attribute])


def _hold_still(things: Iterable[bpy.types.ID | None]) -> None:
    """Drop the animation of materials, lights and the world; they keep the values of the current frame."""
    for thing in things:
        if thing is not None:
            thing.animation_data_clear()
            if getattr(thing, "node_tree", None) is not None:
                thing.node_tree.animation_data_clear()


def _frozen_camera(scene: bpy.types.Scene, source: Path) -> bpy.types.Object:
    """Return a camera that moves by itself as the scene's does, whatever moves that: one key a frame."""
    camera = scene.camera
    if camera.type != "CAMERA" or camera.data.type != "PERSP":
        kind = camera.data.type.lower() if camera.type == "CAMERA" else camera.type.lower()
        raise InputError(f"{source}: its camera {camera.name} is {kind}; only perspective ones have planar depth")
    frozen = bpy.data.objects.new(camera.name, camera.data.copy())
    frozen.data.animation_data_clear()
    frozen.data.dof.use_dof = False
    frozen.rotation_mode = "QUATERNION"
    frozen[FROZEN_NAME] = camera.name
    frozen[FIRST_FRAME], frozen[LAST_FRAME] = scene.frame_start, scene.frame_end
    lens = None
    for number in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(number)
        evaluated = camera.evaluated_get(bpy.context.evaluated_depsgraph_get())
        now = (evaluated.data.lens, evaluated.data.sensor_width, evaluated.data.shift_x, evaluated.data.shift_y)
        if lens is not None and now != lens:
            raise InputError(
                f"{source}: its camera {camera.name} zooms or shifts at frame {number}; a dataset has one set of "
                "intrinsics: keep the lens still"
            )
        lens = now
        location, rotation, _ = evaluated.matrix_world.decompose()
        if number > scene.frame_start and rotation.dot(frozen.rotation_quaternion) < 0:
            rotation.negate()
        frozen.location, frozen.rotation_quaternion = location, rotation
        frozen.keyframe_insert("location", frame=number)
        frozen.keyframe_insert("rotation_quaternion", frame=number)
    return frozen
