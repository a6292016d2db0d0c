"""Foreign materials made fit for depth cameras: opaque, not displaced, with all of their pictures there."""

from collections.abc import Iterator
from pathlib import Path

import bpy

from datagen.errors import InputError

SEE_THROUGH = {
    "BSDF_TRANSPARENT": "a Transparent BSDF",
    "BSDF_GLASS": "a Glass BSDF",
    "BSDF_REFRACTION": "a Refraction BSDF",
    "HOLDOUT": "a Holdout",
    "PRINCIPLED_VOLUME": "a volume",
    "VOLUME_ABSORPTION": "a volume",
    "VOLUME_SCATTER": "a volume",
    "VOLUME_COEFFICIENTS": "a volume",
    "SCRIPT": "a script",
}


def make_opaque(material: bpy.types.Material, source: Path) -> None:
    """Close a material: no alpha, no transmission, and relief in its shading only.

    Raises InputError, naming ``source``, for a material built from what has no surface to measure.
    """
    if hasattr(material, "displacement_method"):
        material.displacement_method = "BUMP"  # true displacement would move the surface away from the ground truth
    if material.node_tree is None:
        return
    for tree in set(_trees(material.node_tree)):
        for node in tree.nodes:
            if node.type in SEE_THROUGH and _is_used(node):
                raise InputError(
                    f"{source}: the material {material.name} uses {SEE_THROUGH[node.type]}, of which a depth camera "
                    "has no surface; give it an opaque one, or hide its objects from renders"
                )
            if node.type == "BSDF_PRINCIPLED":
                _set_unlinked(tree, node, "Alpha", 1.0)
                _set_unlinked(tree, node, "Transmission Weight", 0.0)


def require_textures(source: Path) -> None:
    """Raise InputError unless every picture that Blender's materials read is there: it would show as pink."""
    for image in bpy.data.images:
        if image.source == "FILE" and image.packed_file is None and image.users:
            path = Path(bpy.path.abspath(image.filepath, library=image.library))
            if not path.is_file():
                raise InputError(
                    f"{source}: its texture {path} is missing; put it there, or give the object a material of the "
                    "scene file"
                )


def _trees(tree: bpy.types.NodeTree) -> Iterator[bpy.types.NodeTree]:
    yield tree
    for node in tree.nodes:
        if node.type == "GROUP" and node.node_tree is not None:
            yield from _trees(node.node_tree)


def _is_used(node: bpy.types.Node) -> bool:
    return any(output.is_linked for output in node.outputs)


def _set_unlinked(tree: bpy.types.NodeTree, node: bpy.types.Node, name: str, value: float) -> None:
    socket = node.inputs.get(name)
    if socket is None:
        return
    for link in list(socket.links):
        tree.links.remove(link)
    socket.default_value = value
