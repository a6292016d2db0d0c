"""What the user can do: operators hold properties, make one call and report once."""

from pathlib import Path
from typing import Any

import bpy

from ..errors import ReconstructionError
from ..results.import_reconstruction import import_reconstruction


class SCANBACK_OT_import_reconstruction(bpy.types.Operator):  # type: ignore[misc]  # noqa: N801 - Blender's naming
    """Asks for a folder and imports it."""

    bl_idname = "scanback.import_reconstruction"
    bl_label = "Import Scanback Reconstruction"
    bl_description = "Import a reconstruction folder: coloured mesh, camera path and a camera for each located frame"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender reads it once

    directory: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Folder",
        description="The folder that holds reconstruction.json and mesh.ply",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )
    match_render_size: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Match Render Size",
        description="Give renders the size and pixel aspect of the scan, so that the cameras show what the scan saw",
        default=True,
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    def invoke(self, context: Any, event: Any) -> set[str]:  # noqa: ARG002
        """Ask for the folder."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: Any) -> set[str]:
        """Import it."""
        if not self.directory:
            self.report({"ERROR"}, "No folder chosen; choose the one that 'fusion reconstruct' wrote")
            return {"CANCELLED"}
        folder = Path(bpy.path.abspath(self.directory))
        try:
            collection = import_reconstruction(context.scene, folder, match_render_size=self.match_render_size)
        except ReconstructionError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Imported {folder.name} into the collection {collection.name}")
        return {"FINISHED"}


def _draw_import_entry(menu: Any, context: Any) -> None:  # noqa: ARG001
    menu.layout.operator(SCANBACK_OT_import_reconstruction.bl_idname, text="Scanback Reconstruction")


def register() -> None:
    """Add the operators and the entry of File > Import."""
    bpy.utils.register_class(SCANBACK_OT_import_reconstruction)
    bpy.types.TOPBAR_MT_file_import.append(_draw_import_entry)


def unregister() -> None:
    """Take them away."""
    bpy.types.TOPBAR_MT_file_import.remove(_draw_import_entry)
    bpy.utils.unregister_class(SCANBACK_OT_import_reconstruction)
