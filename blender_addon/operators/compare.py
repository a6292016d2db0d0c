"""Compare: how far the reconstruction is from the original, in colours."""

# mypy: disable-error-code="valid-type,misc"
from typing import Any

import bpy

from ..errors import ReconstructionError
from ..results.error_colors import show_colors
from ..results.scene_collection import MESH_PART, parts
from ..scan_folder import scan_folder
from ..settings import CompareProperties, FolderProperties, chosen
from ..steps.compare import compare_work, compared_settings
from ..steps.scene_reference import remember
from .job_operator import JobOperator, WorkMaker
from .shown_collection import shown_collection


class SCANBACK_OT_compare(JobOperator, FolderProperties, CompareProperties, bpy.types.Operator):  # noqa: N801
    """Compares a reconstruction with the original."""

    bl_idname = "scanback.compare"
    bl_label = "Compare"
    bl_description = "Color each vertex of the mesh by its distance from the original, and measure both"
    title = "Compare"

    def prepare(self, context: Any) -> WorkMaker:
        """Take the original's surface."""
        scene = context.scene
        settings = chosen(self, scene.scanback.compare, CompareProperties)
        truth = compared_settings(settings, scene)
        folder = scan_folder(scene, self.folder)
        # Neither names nor objects stay the same while a job runs; this number does, also when something is undone.
        original = scene.objects[settings["object_name"]].session_uid if truth is not None else 0
        return compare_work(remember(scene), folder, truth=truth, limit=settings["limit"], original=original)


class SCANBACK_OT_show_colors(bpy.types.Operator):  # noqa: N801
    """Chooses what the mesh's colours show."""

    bl_idname = "scanback.show_colors"
    bl_label = "Show Colors"
    bl_description = "Show the scan's own colors on the mesh, or its errors"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    errors: bpy.props.BoolProperty(name="Errors", description="Show the distance from the original")

    def execute(self, context: Any) -> set[str]:
        """Show them."""
        try:
            collection = shown_collection(context)
            for item in parts(collection, MESH_PART):
                show_colors(item, errors=self.errors)
        except ReconstructionError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


CLASSES = (SCANBACK_OT_compare, SCANBACK_OT_show_colors)
register, unregister = bpy.utils.register_classes_factory(CLASSES)
