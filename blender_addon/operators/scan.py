"""Scan: render what is in the scene into a dataset."""

# mypy: disable-error-code="valid-type,misc"
from typing import Any

import bpy

from ..scan_folder import DATASET, scan_folder, settle_folder
from ..settings import FolderProperties, ScanProperties, chosen
from ..steps.scan import begun_scan, prepare_scan, scan_work
from ..steps.scene_reference import push_undo, remember
from .job_operator import JobOperator, WorkMaker


class SCANBACK_OT_scan(JobOperator, FolderProperties, ScanProperties, bpy.types.Operator):  # noqa: N801
    """Renders frames along a path."""

    bl_idname = "scanback.scan"
    bl_label = "Scan"
    bl_description = "Render the subject from all places of the path, with exact depth, in the background"
    title = "Scan"

    overwrite: bpy.props.BoolProperty(
        name="Overwrite", description="Delete an earlier scan in the folder", options={"SKIP_SAVE"}
    )

    def invoke(self, context: Any, event: Any) -> set[str]:
        """Ask before an earlier scan is deleted."""
        if self.overwrite:
            folder = scan_folder(context.scene, self.folder)
            message = f"The frames in {folder / DATASET} are deleted, and rendered anew"
            return context.window_manager.invoke_confirm(self, event, title="Scan Again?", message=message)
        return super().invoke(context, event)

    def execute(self, context: Any) -> set[str]:
        """Scan; once the deletion was confirmed, without waiting."""
        if self.overwrite and not bpy.app.background and self.options.is_invoke:
            return super().invoke(context, None)
        return super().execute(context)

    def prepare(self, context: Any) -> WorkMaker:
        """Write what is to be scanned."""
        scene = context.scene
        remember(scene)
        settings = chosen(self, scene.scanback.scan, ScanProperties)
        folder = scan_folder(scene, self.folder)
        active = context.view_layer.objects.active
        order = prepare_scan(scene, active, folder, settings, overwrite=self.overwrite)
        settle_folder(scene, self.folder)
        push_undo("Scanback: Scan")  # what was scanned is known from now on
        return scan_work(order)


class SCANBACK_OT_resume_scan(JobOperator, FolderProperties, bpy.types.Operator):  # noqa: N801
    """Goes on with a scan."""

    bl_idname = "scanback.resume_scan"
    bl_label = "Go On With the Scan"
    bl_description = "Render the frames that are still missing, of the scene as it was when the scan began"
    title = "Scan"

    def prepare(self, context: Any) -> WorkMaker:
        """Find what was begun."""
        return scan_work(begun_scan(scan_folder(context.scene, self.folder)))


CLASSES = (SCANBACK_OT_scan, SCANBACK_OT_resume_scan)
register, unregister = bpy.utils.register_classes_factory(CLASSES)
