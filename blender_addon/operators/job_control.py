"""What can be done about a job: cancel it, read what it said, and go on."""

# mypy: disable-error-code="valid-type,misc"
from typing import Any

import bpy

from ..jobs import runner
from ..scan_folder import scan_folder

LOG_NAME = "Scanback log"


class SCANBACK_OT_cancel(bpy.types.Operator):  # noqa: N801
    """Cancels the job."""

    bl_idname = "scanback.cancel"
    bl_label = "Cancel"
    bl_description = "End the job; frames that were rendered are kept, and a scan can be gone on with"

    @classmethod
    def poll(cls, context: Any) -> bool:  # noqa: ARG003
        """Tell whether there is a job."""
        return runner.current_job() is not None

    def execute(self, context: Any) -> set[str]:  # noqa: ARG002
        """Ask the job to end."""
        job = runner.current_job()
        if job is not None:
            job.cancel()
        return {"FINISHED"}


class SCANBACK_OT_dismiss(bpy.types.Operator):  # noqa: N801
    """Removes the message of the last job."""

    bl_idname = "scanback.dismiss"
    bl_label = "Dismiss"
    bl_description = "Remove this message"

    def execute(self, context: Any) -> set[str]:  # noqa: ARG002
        """Remove it."""
        runner.dismiss()
        return {"FINISHED"}


class SCANBACK_OT_show_log(bpy.types.Operator):  # noqa: N801
    """Shows what the job said."""

    bl_idname = "scanback.show_log"
    bl_label = "Show Log"
    bl_description = "Put the last lines that the job printed into a text, to be read in the Text Editor"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def execute(self, context: Any) -> set[str]:  # noqa: ARG002
        """Write the text."""
        job = runner.current_job() or runner.last_job()
        if job is None:
            self.report({"INFO"}, "No job was run yet")
            return {"CANCELLED"}
        text = bpy.data.texts.get(LOG_NAME) or bpy.data.texts.new(LOG_NAME)
        text.clear()
        text.write("\n".join([job.title, job.message, *job.log.lines, ""]))
        self.report({"INFO"}, f"The log is the text '{LOG_NAME}' of the Text Editor")
        return {"FINISHED"}


class SCANBACK_OT_open_folder(bpy.types.Operator):  # noqa: N801
    """Opens the scan's folder."""

    bl_idname = "scanback.open_folder"
    bl_label = "Open Folder"
    bl_description = "Open the folder of the scan and its reconstruction in the system's file browser"

    def execute(self, context: Any) -> set[str]:
        """Open it."""
        folder = scan_folder(context.scene)
        if not folder.is_dir():
            self.report({"ERROR"}, f"{folder}: not there yet; scan first")
            return {"CANCELLED"}
        bpy.ops.wm.path_open(filepath=str(folder))
        return {"FINISHED"}


CLASSES = (SCANBACK_OT_cancel, SCANBACK_OT_dismiss, SCANBACK_OT_show_log, SCANBACK_OT_open_folder)


def register() -> None:
    """Add the operators."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Take them away, and end what runs."""
    runner.end_all()
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
