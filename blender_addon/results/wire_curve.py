"""Lines that render: poly curves, any number of them in one object, round and thin in renders.

In viewports they are plain lines: a camera on its path, or at the tip of its own frustum, would stand inside a tube
and see its walls.
"""

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

TUBES = "Scanback tubes"
"""The node group that makes tubes of lines. Its inputs: the lines, half the tubes' thickness, their material."""
CORNERS = 6


def create_wire(
    name: str, polylines: Sequence[NDArray[np.floating]], *, closed: Sequence[bool] | None = None
) -> bpy.types.Curve:
    """Return new curve data that draws ``polylines``, each (N, 3), closed where ``closed`` says so."""
    curve = bpy.data.curves.new(name, "CURVE")
    curve.dimensions = "3D"
    for index, points in enumerate(polylines):
        spline = curve.splines.new("POLY")
        spline.points.add(len(points) - 1)
        spline.points.foreach_set("co", np.column_stack([points, np.ones(len(points))]).ravel())
        spline.use_cyclic_u = closed is not None and closed[index]
    return curve


def render_as_tubes(item: bpy.types.Object, *, radius: float, material: bpy.types.Material) -> None:
    """Have an object's lines rendered as tubes of a radius and a material."""
    modifier = item.modifiers.new("Tubes", "NODES")
    modifier.node_group = _tubes()
    _give(modifier, "Radius", radius)
    _give(modifier, "Material", material)
    modifier.show_viewport = False


def tubes_of(item: bpy.types.Object) -> set[bpy.types.NodeTree]:
    """Return the node groups by which an object's lines become tubes."""
    return {modifier.node_group for modifier in item.modifiers if modifier.type == "NODES"} - {None}


def materials_of_tubes(item: bpy.types.Object) -> set[bpy.types.Material]:
    """Return the materials that an object's tubes have."""
    ours = [modifier for modifier in item.modifiers if modifier.type == "NODES" and modifier.node_group is not None]
    found = {_given(modifier, "Material") for modifier in ours}
    return {material for material in found if isinstance(material, bpy.types.Material)}


def _give(modifier: Any, name: str, value: Any) -> None:
    """Set an input of a modifier's node group, which has its own place since Blender 5.2."""
    key = _input(modifier.node_group, name)
    if hasattr(modifier, "properties"):
        getattr(modifier.properties.inputs, key).value = value
    else:
        modifier[key] = value


def _given(modifier: Any, name: str) -> Any:
    """Return what an input of a modifier's node group is set to, None where it has none of that name."""
    key = _input(modifier.node_group, name)
    if hasattr(modifier, "properties"):
        return getattr(getattr(modifier.properties.inputs, key, None), "value", None)
    return modifier.get(key)


def _input(group: bpy.types.NodeTree, name: str) -> str:
    """Return by which key a modifier has one of the group's inputs; empty where the group has none of the name."""
    inputs = [socket for socket in group.interface.items_tree if socket.item_type == "SOCKET"]
    return next((item.identifier for item in inputs if item.in_out == "INPUT" and item.name == name), "")


def _tubes() -> bpy.types.NodeTree:
    """Return the node group, made where the file has none."""
    there = bpy.data.node_groups.get(TUBES)
    if there is not None and there.library is None:
        return there
    group = bpy.data.node_groups.new(TUBES, "GeometryNodeTree")
    group.interface.new_socket("Lines", in_out="INPUT", socket_type="NodeSocketGeometry")
    group.interface.new_socket("Radius", in_out="INPUT", socket_type="NodeSocketFloat")
    group.interface.new_socket("Material", in_out="INPUT", socket_type="NodeSocketMaterial")
    group.interface.new_socket("Tubes", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    kinds = ("NodeGroupInput", "GeometryNodeCurvePrimitiveCircle", "GeometryNodeCurveToMesh", "GeometryNodeSetMaterial")
    given, section, tubes, dressed = (group.nodes.new(kind) for kind in kinds)
    result = group.nodes.new("NodeGroupOutput")
    section.inputs["Resolution"].default_value = CORNERS
    tubes.inputs["Fill Caps"].default_value = True
    for source, target in (
        (given.outputs["Radius"], section.inputs["Radius"]),
        (given.outputs["Lines"], tubes.inputs["Curve"]),
        (section.outputs["Curve"], tubes.inputs["Profile Curve"]),
        (tubes.outputs["Mesh"], dressed.inputs["Geometry"]),
        (given.outputs["Material"], dressed.inputs["Material"]),
        (dressed.outputs["Geometry"], result.inputs["Tubes"]),
    ):
        group.links.new(source, target)
    for place, node in enumerate((given, section, tubes, dressed, result)):
        node.location = (200 * place, 0)
    return group
