"""The tab 'Scanback' in the sidebar of the 3D Viewport."""

from typing import Any

import bpy

from ..operators.import_files import SCANBACK_OT_import_reconstruction


class SCANBACK_PT_reconstruction(bpy.types.Panel):  # type: ignore[misc]  # noqa: N801 - Blender's naming
    """Bring a reconstruction into the scene."""

    bl_idname = "SCANBACK_PT_reconstruction"
    bl_label = "Reconstruction"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Scanback"

    def draw(self, context: Any) -> None:  # noqa: ARG002
        """Draw the button."""
        self.layout.operator(SCANBACK_OT_import_reconstruction.bl_idname, text="Import Folder", icon="IMPORT")


def register() -> None:
    """Add the panel."""
    bpy.utils.register_class(SCANBACK_PT_reconstruction)


def unregister() -> None:
    """Take it away."""
    bpy.utils.unregister_class(SCANBACK_PT_reconstruction)
