"""The materials of a scene file as Cycles' shader nodes: opaque, so that depth is that of what is seen."""

from collections.abc import Sequence

import bpy
import numpy as np

from datagen.color import linear_from_srgb
from datagen.scene_spec.materials import MaterialSettings
from datagen.textures.paint import paint
from datagen.textures.picture import Picture

UV_SURFACE = "surface"
"""The UV map that textured materials read: places on the picture, whose sides are 1 long."""

NEUTRAL_COLOR = (0.72, 0.70, 0.67)


def add_material(name: str, settings: MaterialSettings) -> bpy.types.Material:
    """Add a material; a texture is painted once, here, and read as an image: cheaper than noise at every sample."""
    material, surface = _new_material(name)
    inputs = surface.inputs
    inputs["Roughness"].default_value = settings.roughness
    inputs["Metallic"].default_value = settings.metallic
    inputs["Coat Weight"].default_value = settings.coat
    inputs["Coat Roughness"].default_value = 0.15
    inputs["Sheen Weight"].default_value = settings.sheen
    if settings.texture is None:
        assert settings.color is not None
        inputs["Base Color"].default_value = linear_rgba(settings.color)
        return material
    tree = material.node_tree
    picture = tree.nodes.new("ShaderNodeTexImage")
    picture.image = image_of(paint(settings.texture), name=name)
    places = tree.nodes.new("ShaderNodeUVMap")
    places.uv_map = UV_SURFACE
    tree.links.new(places.outputs["UV"], picture.inputs["Vector"])
    tree.links.new(picture.outputs["Color"], inputs["Base Color"])
    # Roughness varies about its value by the share ``gloss``: alpha holds 0 for the glossiest, 1 for the dullest.
    variation = tree.nodes.new("ShaderNodeMath")
    variation.operation = "MULTIPLY_ADD"
    variation.use_clamp = True
    span = settings.texture.gloss * settings.roughness
    tree.links.new(picture.outputs["Alpha"], variation.inputs[0])
    variation.inputs[1].default_value = 2 * span
    variation.inputs[2].default_value = settings.roughness - span
    tree.links.new(variation.outputs["Value"], inputs["Roughness"])
    return material


def add_vertex_color_material(name: str, attribute: str) -> bpy.types.Material:
    """Add a matt material that shows a mesh's colour attribute."""
    material, surface = _new_material(name)
    surface.inputs["Roughness"].default_value = 0.6
    colors = material.node_tree.nodes.new("ShaderNodeVertexColor")
    colors.layer_name = attribute
    material.node_tree.links.new(colors.outputs["Color"], surface.inputs["Base Color"])
    return material


def add_neutral_material() -> bpy.types.Material:
    """Add the material of models that bring neither material nor colours."""
    return add_material("neutral", MaterialSettings(color=NEUTRAL_COLOR, roughness=0.6))


def image_of(picture: Picture, *, name: str) -> bpy.types.Image:
    """Return a picture as an 8-bit Blender image, its dullness in alpha, apart from the colours."""
    height, width = picture.dullness.shape
    image = bpy.data.images.new(name, width, height, alpha=True)
    image.alpha_mode = "CHANNEL_PACKED"
    pixels = np.concatenate([picture.color, (picture.dullness[..., None] + 1) / 2], axis=-1, dtype=np.float32)
    image.pixels.foreach_set(pixels[::-1].ravel())  # Blender's first row is the lowest
    image.update()
    return image


def linear_rgba(color: Sequence[float]) -> tuple[float, float, float, float]:
    """Return an sRGB colour as Blender's nodes take it: linear, with an opaque alpha."""
    red, green, blue = (float(value) for value in linear_from_srgb(color))
    return (red, green, blue, 1.0)


def _new_material(name: str) -> tuple[bpy.types.Material, bpy.types.Node]:
    material = bpy.data.materials.new(name)
    if material.node_tree is None:  # before Blender 5.0 a material has no nodes until it is asked for them
        material.use_nodes = True
    return material, next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
