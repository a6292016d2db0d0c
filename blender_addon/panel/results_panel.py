"""What can be done with a reconstruction that is in the scene."""

from typing import Any

import bpy

from ..operators.import_files import SCANBACK_OT_import_reconstruction
from ..operators.shown_collection import find_shown
from ..operators.sides import SIDES, SCANBACK_OT_show_side
from ..operators.views import SCANBACK_OT_look_through, SCANBACK_OT_replay, SCANBACK_OT_step_view
from ..results.look_through import FRAME, RANKING, neighbour, view_camera
from ..results.originals import is_shown, originals_of
from ..results.scene_collection import MESH_PART, folder_of, parts


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
            self._draw_sides(context, collection)
            self._draw_look(context)
            self._draw_view(collection)
            self.layout.operator(SCANBACK_OT_replay.bl_idname, icon="PLAY")
        self.layout.operator(SCANBACK_OT_import_reconstruction.bl_idname, text="Import Folder", icon="IMPORT")

    def _draw_sides(self, context: Any, collection: bpy.types.Collection) -> None:
        """Draw what is shown of what stands in one place: what was scanned, or its reconstruction."""
        originals = originals_of(context.scene, folder_of(collection))
        if not originals:
            return
        shown = is_shown(context.scene, originals), is_shown(context.scene, parts(collection, MESH_PART))
        now = {(True, False): "ORIGINAL", (False, True): "RECONSTRUCTION", (True, True): "BOTH"}.get(shown)
        row = self.layout.row(align=True)
        for side, label, _ in SIDES:
            row.operator(SCANBACK_OT_show_side.bl_idname, text=label, depress=side == now).side = side

    def _draw_look(self, context: Any) -> None:
        column = self.layout.column(align=True)
        column.label(text="Look through the frame nearest to")
        row = column.row(align=True)
        active = context.view_layer.objects.active
        can = {"CURSOR": True, "SELECTION": bool(context.selected_objects)}
        can["QUERY"] = active is not None and RANKING in active
        for target, text in (("CURSOR", "Cursor"), ("SELECTION", "Selection"), ("QUERY", "Query")):
            button = row.row(align=True)
            button.enabled = can[target]
            button.operator(SCANBACK_OT_look_through.bl_idname, text=text).target = target

    def _draw_view(self, collection: bpy.types.Collection) -> None:
        """Draw the steps from one frame to the next, and how the frame's picture is shown."""
        camera = view_camera(collection)
        if camera is None:
            return
        column = self.layout.column(align=True)
        row = column.row(align=True)
        for step, icon in ((-1, "TRIA_LEFT"), (1, "TRIA_RIGHT")):
            button = row.row(align=True)
            button.enabled = neighbour(camera, step) is not None
            button.operator(SCANBACK_OT_step_view.bl_idname, text="", icon=icon).step = step
            if step == -1:
                middle = row.row(align=True)
                middle.alignment = "CENTER"
                middle.label(text=f"Frame {camera.get(FRAME, '?')}")
        if not camera.data.background_images:
            return
        picture = camera.data.background_images[0]
        column.prop(picture, "alpha", text="Picture", slider=True)
        column.row(align=True).prop(picture, "display_depth", expand=True)


def register() -> None:
    """Add the panel."""
    bpy.utils.register_class(SCANBACK_PT_reconstruction)


def unregister() -> None:
    """Take it away."""
    bpy.utils.unregister_class(SCANBACK_PT_reconstruction)
