"""Renders of a scene in which everything emits its own colour: a few samples smooth the edges, no light is traced."""

from pathlib import Path

import bpy

from datagen.atomic_write import replacing
from datagen.interrupts import interrupts_held

WORLD_GREY_LINEAR = 0.75


def set_up_presentation(scene: bpy.types.Scene, *, samples: int) -> None:
    """Prepare an empty scene: Cycles on the CPU, colours as they are, a light grey world."""
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = samples
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.use_denoising = False
    scene.cycles.max_bounces = 0
    scene.view_settings.view_transform = "Standard"
    scene.render.dither_intensity = 0
    scene.render.image_settings.file_format = "PNG"
    world = bpy.data.worlds.new("World")
    if world.node_tree is None:  # always there since Blender 5.0, which deprecates the switch
        world.use_nodes = True
    nodes = world.node_tree.nodes
    nodes.clear()
    background, output = nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeOutputWorld")
    background.inputs["Color"].default_value = (*[WORLD_GREY_LINEAR] * 3, 1.0)
    world.node_tree.links.new(background.outputs[0], output.inputs["Surface"])
    scene.world = world


def render_png(scene: bpy.types.Scene, camera: bpy.types.Object, path: Path) -> None:
    """Render ``scene`` through ``camera`` at its own size and write ``path`` atomically."""
    scene.camera = camera
    with replacing(path) as temporary:
        with interrupts_held():  # Cycles prints one, and renders on
            bpy.ops.render.render(scene=scene.name)
        # Not through the scene's output path: Blender takes braces in that for a template.
        bpy.data.images["Render Result"].save_render(str(temporary), scene=scene)
