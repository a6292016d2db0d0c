"""Lamps and the world around."""

import math

import bpy
import numpy as np
from mathutils import Vector

from datagen.blender.materials import linear_rgba
from datagen.scene_spec.lights import (
    DEFAULT_LIGHT_SIZE,
    DEFAULT_SUN_ANGLE_DEG,
    LightSettings,
    SkySettings,
    WorldSettings,
)
from datagen.textures.sky import sky

SKY_WIDTH = 768


def add_light(scene: bpy.types.Scene, settings: LightSettings, *, name: str) -> None:
    """Add a lamp to ``scene``."""
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


def set_world(scene: bpy.types.Scene, settings: WorldSettings) -> None:
    """Give ``scene`` a background of one colour, or a sky."""
    world = bpy.data.worlds.new("World")
    if world.node_tree is None:
        world.use_nodes = True
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = linear_rgba(settings.color)
    background.inputs["Strength"].default_value = settings.strength
    if settings.sky is not None:
        picture = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
        picture.image = _sky_image(settings.sky, zenith=settings.color)
        world.node_tree.links.new(picture.outputs["Color"], background.inputs["Color"])
        # So soft a sky is found by bounced rays as well as by aiming at it, which then aim at the lamps alone: measured
        # on the table, 13 % faster and half a decibel better at 4 samples.
        world.cycles.sampling_method = "NONE"
    scene.world = world


def _sky_image(settings: SkySettings, *, zenith: tuple[float, float, float]) -> bpy.types.Image:
    light = sky(
        np.random.default_rng(settings.seed),
        SKY_WIDTH,
        zenith=zenith,
        horizon=settings.horizon,
        ground=settings.ground,
        clouds=settings.clouds,
    )
    image = bpy.data.images.new("sky", SKY_WIDTH, SKY_WIDTH // 2, float_buffer=True)
    pixels = np.concatenate([light, np.ones_like(light[..., :1])], axis=-1)
    image.pixels.foreach_set(pixels[::-1].ravel())
    image.update()
    return image
