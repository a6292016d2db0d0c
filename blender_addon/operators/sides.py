"""The original or its reconstruction: which of both, that stand in one place, is shown."""

# mypy: disable-error-code="valid-type,misc"
from typing import Any

import bpy

from ..errors import ReconstructionError
from ..results.originals import originals_of, show_sides
from ..results.scene_collection import folder_of
from ..results.viewport_colors import suit_shading
from .shown_collection import find_shown, shown_collection

SIDES = (
    ("ORIGINAL", "Original", "Show what was scanned and hide its reconstruction"),
    ("RECONSTRUCTION", "Mesh", "Show the reconstruction and hide what was scanned"),
    ("BOTH", "Both", "Show both; where they coincide, they flicker"),
)


class SCANBACK_OT_show_side(bpy.types.Operator):  # noqa: N801 - Blender's naming
    """Shows the original, its reconstruction, or both."""

    bl_idname = "scanback.show_side"
    bl_label = "Show Original or Reconstruction"
    bl_description = "Choose which is shown of what was scanned and its reconstruction, in viewports and renders"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender reads it once

    side: bpy.props.EnumProperty(
        name="Show", description="What viewports and renders show", items=SIDES, default="RECONSTRUCTION"
    )

    @classmethod
    def description(cls, context: Any, properties: Any) -> str:  # noqa: ARG003
        """Say what this side is."""
        return next(text for side, _, text in SIDES if side == properties.side)

    @classmethod
    def poll(cls, context: Any) -> bool:
        """Tell whether there are two sides."""
        collection = find_shown(context)
        if collection is None:
            cls.poll_message_set("The scene has no reconstruction")
            return False
        if not originals_of(context.scene, folder_of(collection)):
            cls.poll_message_set("What was scanned is not in this scene")
            return False
        return True

    def execute(self, context: Any) -> set[str]:
        """Show it."""
        try:
            collection = shown_collection(context)
        except ReconstructionError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        show_sides(
            context.scene,
            collection,
            original=self.side != "RECONSTRUCTION",
            reconstruction=self.side != "ORIGINAL",
        )
        suit_shading(context.scene)
        return {"FINISHED"}


register, unregister = bpy.utils.register_classes_factory((SCANBACK_OT_show_side,))
