"""A declared scene made in Blender: objects, materials, lights and the world."""

import math
from collections.abc import Sequence

import bpy
from mathutils import Vector

from datagen.color import linear_from_srgb
from datagen.scene_spec.lights import DEFAULT_LIGHT_SIZE, DEFAULT_SUN_ANGLE_DEG, LightSettings, WorldSettings
from datagen.scene_spec.materials import MaterialSettings
from datagen.scene_spec.objects import ObjectSettings
from datagen.scene_spec.scene import Scene


def build_scene(spec: Scene) -> bpy.types.Scene:
    """Empty Blender and make the objects, materials, lights and world of ``spec`` in it; the camera comes apart."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.name = spec.name
    materials = {name: _add_material(name, settings) for name, settings in spec.materials.items()}
    for settings in spec.objects:
        _add_object(settings, materials[settings.material])
    for number, light in enumerate(spec.lights):
        _add_light(scene, light, name=f"{light.type}.{number}")
    _set_world(scene, spec.world)
    return scene


def linear_rgba(color: Sequence[float]) -> tuple[float, float, float, float]:
    """Return an sRGB colour as Blender's nodes take it: linear, with an opaque alpha."""
    red, green, blue = (float(value) for value in linear_from_srgb(color))
    return (red, green, blue, 1.0)


def _add_object(settings: ObjectSettings, material: bpy.types.Material) -> None:
    shape = _add_shape(settings.shape)
    shape.name = shape.data.name = settings.name
    shape.location = settings.location
    shape.rotation_euler = [math.radians(angle) for angle in settings.rotation_deg]
    shape.scale = settings.scale
    shape.data.materials.append(material)
    shape.data.polygons.foreach_set("use_smooth", [settings.smooth] * len(shape.data.polygons))
    if settings.subdivision:
        modifier = shape.modifiers.new("Subdivision", "SUBSURF")
        # The same in both, so that the ground truth from the evaluated scene is what Cycles renders.
        modifier.levels = modifier.render_levels = settings.subdivision


def _add_shape(shape: str) -> bpy.types.Object:
    """Add a primitive at the origin, round ones finely enough that their facets are not seen."""
    mesh = bpy.ops.mesh
    if shape == "suzanne":
        mesh.primitive_monkey_add()
    elif shape == "sphere":
        mesh.primitive_ico_sphere_add(subdivisions=6, radius=1.0)
    elif shape == "cube":
        mesh.primitive_cube_add(size=2.0)
    elif shape == "plane":
        mesh.primitive_plane_add(size=2.0)
    elif shape == "cylinder":
        mesh.primitive_cylinder_add(vertices=128, radius=1.0, depth=2.0)
    elif shape == "cone":
        mesh.primitive_cone_add(vertices=128, radius1=1.0, depth=2.0)
    elif shape == "torus":
        mesh.primitive_torus_add(major_segments=128, minor_segments=48, major_radius=1.0, minor_radius=0.25)
    else:
        raise AssertionError(f"shape {shape} is declared in scene_spec but not made here")
    return bpy.context.object


def _add_material(name: str, settings: MaterialSettings) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    if material.node_tree is None:  # before Blender 5.0 a material has no nodes until it is asked for them
        material.use_nodes = True
    surface = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    surface.inputs["Base Color"].default_value = linear_rgba(settings.color)
    surface.inputs["Roughness"].default_value = settings.roughness
    surface.inputs["Metallic"].default_value = settings.metallic
    return material


def _add_light(scene: bpy.types.Scene, settings: LightSettings, *, name: str) -> None:
    data = bpy.data.lights.new(name, settings.type.upper())
    data.color = linear_rgba(settings.color)[:3]
    data.energy = settings.power
    if settings.type == "area":
        data.size = settings.size or DEFAULT_LIGHT_SIZE
    elif settings.type == "point":
        data.shadow_soft_size = settings.size or DEFAULT_LIGHT_SIZE
    else:
        data.angle = math.radians(DEFAULT_SUN_ANGLE_DEG if settings.angle_deg is None else settings.angle_deg)
    light = bpy.data.objects.new(name, data)
    light.location = settings.position
    direction = Vector(settings.target) - Vector(settings.position)
    light.rotation_mode = "QUATERNION"
    light.rotation_quaternion = direction.to_track_quat("-Z", "Y")
    scene.collection.objects.link(light)


def _set_world(scene: bpy.types.Scene, settings: WorldSettings) -> None:
    world = bpy.data.worlds.new("World")
    if world.node_tree is None:
        world.use_nodes = True
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = linear_rgba(settings.color)
    background.inputs["Strength"].default_value = settings.strength
    scene.world = world
