"""What can be done with a reconstruction that is in the scene."""

from typing import Any

import bpy

from ..operators.import_files import SCANBACK_OT_import_reconstruction
from ..operators.shown_collection import find_shown
from ..operators.views import SCANBACK_OT_look_through, SCANBACK_OT_replay, SCANBACK_OT_step_view
from ..results.look_through import FRAME, view_camera


class SCANBACK_PT_reconstruction(bpy.types.Panel):  # type: ignore[misc]  # noqa: N801 - Blender's naming
    """Look at a reconstruction in the scene, or bring one in."""

    bl_idname = "SCANBACK_PT_reconstruction"
    bl_label = "Reconstruction"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Scanback"
    bl_order = 5

    def draw(self, context: Any) -> None:
        """Draw the buttons."""
        collection = find_shown(context)
        if collection is not None:
            self._draw_views(collection)
        self.layout.operator(SCANBACK_OT_import_reconstruction.bl_idname, text="Import Folder", icon="IMPORT")

    def _draw_views(self, collection: bpy.types.Collection) -> None:
        column = self.layout.column(align=True)
        column.label(text="Look through the nearest frame to the")
        row = column.row(align=True)
        for target, text in (("CURSOR", "Cursor"), ("SELECTION", "Selection"), ("QUERY", "Query")):
            row.operator(SCANBACK_OT_look_through.bl_idname, text=text).target = target
        camera = view_camera(collection)
        if camera is not None:
            row = column.row(align=True)
            row.operator(SCANBACK_OT_step_view.bl_idname, text="", icon="TRIA_LEFT").step = -1
            row.label(text=f"Frame {camera.get(FRAME, '?')}")
            row.operator(SCANBACK_OT_step_view.bl_idname, text="", icon="TRIA_RIGHT").step = 1
        column.operator(SCANBACK_OT_replay.bl_idname, icon="PLAY")


def register() -> None:
    """Add the panel."""
    bpy.utils.register_class(SCANBACK_PT_reconstruction)


def unregister() -> None:
    """Take it away."""
    bpy.utils.unregister_class(SCANBACK_PT_reconstruction)
