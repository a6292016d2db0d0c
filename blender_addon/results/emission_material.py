"""Materials that show a colour as it is, without light: scan colours already hold the light of the scan."""

import bpy


def colored_by_attribute(name: str, attribute: str) -> bpy.types.Material:
    """Return a new material that emits the colours of the mesh attribute ``attribute``."""
    material, emission = _emission_material(name)
    colors = material.node_tree.nodes.new("ShaderNodeVertexColor")
    colors.layer_name = attribute
    colors.location = (-200, 0)
    material.node_tree.links.new(colors.outputs["Color"], emission.inputs["Color"])
    return material


def colored_wire(name: str, color_linear: tuple[float, float, float]) -> bpy.types.Material:
    """Return a new material of one colour that cannot be seen from inside.

    A camera stands inside the tubes that mark its path and view; the sides that face away being transparent, they do
    not hide what it sees.
    """
    material, emission = _emission_material(name)
    material.diffuse_color = (*color_linear, 1.0)  # what the Solid view shows
    emission.inputs["Color"].default_value = (*color_linear, 1.0)
    nodes, links = material.node_tree.nodes, material.node_tree.links
    side = nodes.new("ShaderNodeNewGeometry")
    side.location = (0, 300)
    transparent = nodes.new("ShaderNodeBsdfTransparent")
    transparent.location = (0, -150)
    mix = nodes.new("ShaderNodeMixShader")
    mix.location = (200, 0)
    output = nodes["Material Output"]
    links.new(side.outputs["Backfacing"], mix.inputs[0])
    links.new(emission.outputs[0], mix.inputs[1])
    links.new(transparent.outputs[0], mix.inputs[2])
    links.new(mix.outputs[0], output.inputs["Surface"])
    return material


def _emission_material(name: str) -> tuple[bpy.types.Material, bpy.types.Node]:
    material = bpy.data.materials.new(name)
    if material.node_tree is None:  # always there since Blender 5.0, which deprecates the switch
        material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    emission = nodes.new("ShaderNodeEmission")
    output = nodes.new("ShaderNodeOutputMaterial")
    output.location = (400, 0)
    material.node_tree.links.new(emission.outputs[0], output.inputs["Surface"])
    if hasattr(material, "cycles"):
        # It is there to be seen, not to give light: a million triangles as lamps would cost time and change the scene.
        material.cycles.emission_sampling = "NONE"
    return material, emission
