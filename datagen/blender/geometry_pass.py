"""Normals of the surfaces that the first samples hit.

Cycles averages its normal pass over all samples, which blurs it at edges, and shades it (smooth shading, bumps). So the
same objects stand in a second scene, where every surface glows in the colour of its geometric normal, and one sample a
pixel takes it: the sample that depth comes from. The second scene keeps its acceleration structure from frame to frame.
"""

from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from datagen.blender.render import configure_render, pass_channel, read_channels, render_exr
from datagen.rigid import Matrix
from datagen.scene_spec.render_settings import RenderSettings

SAME_DEPTH = np.float32(1e-3)
"""Both scenes give the same bits, but depth may have been made more precise since."""


def add_geometry_scene(scene: bpy.types.Scene, settings: RenderSettings, *, threads: int) -> bpy.types.Scene:
    """Return a scene with the objects and the camera of ``scene``, whose surfaces show their normals."""
    geometry = bpy.data.scenes.new("Geometry")
    for collection in scene.collection.children:
        geometry.collection.children.link(collection)
    for item in scene.collection.objects:
        geometry.collection.objects.link(item)
    geometry.camera = scene.camera
    configure_render(geometry, settings, threads=threads)
    geometry.render.pixel_aspect_x = scene.render.pixel_aspect_x
    geometry.render.pixel_aspect_y = scene.render.pixel_aspect_y
    geometry.cycles.samples = 1
    geometry.cycles.max_bounces = 0
    geometry.cycles.use_denoising = False
    geometry.cycles.device = scene.cycles.device
    geometry.view_layers[0].use_pass_object_index = False
    geometry.view_layers[0].material_override = _normal_material()
    return geometry


def render_normals_exr(geometry: bpy.types.Scene, frame: int, *, exr: Path) -> None:
    """Render the geometry scene's ``frame`` into an EXR file, for ``read_normals``."""
    render_exr(geometry, frame, seed=0, exr=exr)


def read_normals(exr: Path, *, depth: NDArray[np.float32], world_from_camera: Matrix) -> NDArray[np.float32]:
    """Return unit normals (H, W, 3), camera axes, towards the camera, of the file, which is deleted.

    0 where ``depth`` has no surface, and where the geometry scene's depth is another: there colours and depth saw
    through a transparent part of the surface, which glows here. Safe in a thread: it does not touch Blender.
    """
    channels = read_channels(exr)
    halved = np.stack([pass_channel(channels, f"Combined.{band}") for band in "RGB"], axis=-1)
    normals = (halved * np.float32(2) - np.float32(1)) @ world_from_camera[:3, :3].astype(np.float32)
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    seen = (depth > 0) & (np.abs(pass_channel(channels, "Depth.") - depth) <= SAME_DEPTH * depth)
    return np.where(seen[..., None], normals / np.maximum(lengths, np.float32(1e-9)), np.float32(0))


def _normal_material() -> bpy.types.Material:
    """Return a material that emits (n + 1) / 2 of the geometric normal n, world axes, on the side that is seen."""
    material = bpy.data.materials.new("Geometric normal")
    if material.node_tree is None:
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    surface = tree.nodes.new("ShaderNodeNewGeometry")
    halve = tree.nodes.new("ShaderNodeVectorMath")
    halve.operation = "MULTIPLY_ADD"
    halve.inputs[1].default_value = halve.inputs[2].default_value = (0.5, 0.5, 0.5)
    glow = tree.nodes.new("ShaderNodeEmission")
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(surface.outputs["True Normal"], halve.inputs[0])
    tree.links.new(halve.outputs[0], glow.inputs["Color"])
    tree.links.new(glow.outputs[0], output.inputs["Surface"])
    return material
