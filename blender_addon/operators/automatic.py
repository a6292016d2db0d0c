"""Lengths that are chosen for the user, until they choose themselves."""

# mypy: disable-error-code="valid-type,misc"
from typing import Any

import bpy

from ..results.error_colors import NUMBERS_KEY, has_errors
from ..results.scene_collection import MESH_PART, parts
from ..steps.automatic import suggestion
from .shown_collection import find_shown

LENGTHS = (
    ("scan.distance", "Distance", "From the subject to the camera"),
    ("fuse.voxel_size", "Voxel Size", "The side of a voxel"),
    ("fuse.truncation", "Truncation", "How far from the surface voxels are filled"),
    ("fuse.depth_max", "Farthest", "The depth beyond which all is left out"),
    ("compare.limit", "Full Color At", "The distance from which errors have the last color"),
)


class SCANBACK_OT_choose_length(bpy.types.Operator):  # noqa: N801 - Blender's naming
    """Takes a length over from what is chosen, or gives it back."""

    bl_idname = "scanback.choose_length"
    bl_label = "Choose a Length"
    bl_description = "Choose a length yourself, beginning with what it amounts to now, or have it chosen again"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender reads it once

    length: bpy.props.EnumProperty(name="Length", description="Which length of which step", items=LENGTHS)
    automatic: bpy.props.BoolProperty(name="Automatic", description="Have it chosen", default=False)

    @classmethod
    def description(cls, context: Any, properties: Any) -> str:  # noqa: ARG003
        """Say what is chosen."""
        what = next(text for name, _, text in LENGTHS if name == properties.length)
        return f"{what}: have it chosen again" if properties.automatic else f"{what}: choose it yourself"

    def execute(self, context: Any) -> set[str]:
        """Choose it, or have it chosen."""
        scene = context.scene
        step, _, name = self.length.partition(".")
        length = 0.0
        if not self.automatic:
            length = suggestion(name, scene, context.view_layer.objects.active, limit_m=_shown_limit_m(context))
        setattr(getattr(scene.scanback, step), name, length)
        return {"FINISHED"}


def _shown_limit_m(context: Any) -> float | None:
    collection = find_shown(context)
    meshes = parts(collection, MESH_PART) if collection is not None else []
    return next((float(item[NUMBERS_KEY]["limit_m"]) for item in meshes if has_errors(item)), None)


register, unregister = bpy.utils.register_classes_factory((SCANBACK_OT_choose_length,))
