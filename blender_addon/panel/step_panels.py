"""The four steps, top to bottom, and what runs now."""

from typing import Any

import bpy

from ..jobs import runner
from ..jobs.job import Job, State
from ..operators.compare import SCANBACK_OT_compare, SCANBACK_OT_show_colors
from ..operators.fuse import SCANBACK_OT_estimate, SCANBACK_OT_fuse
from ..operators.job_control import (
    SCANBACK_OT_cancel,
    SCANBACK_OT_dismiss,
    SCANBACK_OT_open_folder,
    SCANBACK_OT_show_log,
)
from ..operators.locate import SCANBACK_OT_locate
from ..operators.scan import SCANBACK_OT_resume_scan, SCANBACK_OT_scan
from ..operators.shown_collection import find_shown
from ..results.error_colors import NUMBERS_KEY, has_errors, shows_errors
from ..results.scene_collection import MESH_PART, parts
from ..results.scene_units import length_text, metres_per_unit
from ..scan_folder import scan_folder
from ..steps import reasons
from ..steps.estimate import VOXELS_PER_TRUNCATION, known_estimate
from ..steps.fuse_source import dataset_of
from ..steps.status import status_of
from .log_tail import last_lines, worth_showing
from .step_settings import automatic_limit, automatic_truncation, automatic_voxel_size, draw_length, draw_settings
from .wrapped_text import BOX_EDGE, draw_wrapped, wrapped

LOG_LINES_SHOWN = 4


class _StepPanel:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Scanback"

    def draw_button(self, context: Any, button: Any, reason: str | None, **arguments: Any) -> None:
        """Draw a step's button; where it cannot run, grey and with the reason below."""
        column = self.layout.column()  # type: ignore[attr-defined]
        row = column.row()
        row.scale_y = 1.3
        row.enabled = reason is None
        drawn = row.operator(button.bl_idname, text=arguments.pop("text", None), icon=arguments.pop("icon", "NONE"))
        for name, value in arguments.items():
            setattr(drawn, name, value)
        if reason is not None:
            draw_wrapped(column, context, reason, icon="INFO")


class SCANBACK_PT_job(_StepPanel, bpy.types.Panel):  # type: ignore[misc]  # noqa: N801 - Blender's naming
    """What runs, or how it ended."""

    bl_idname = "SCANBACK_PT_job"
    bl_label = "Progress"
    bl_order = 0
    bl_options = {"HIDE_HEADER"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: Any) -> bool:  # noqa: ARG003
        """Tell whether there is anything to say."""
        return runner.current_job() is not None or runner.last_job() is not None

    def draw(self, context: Any) -> None:
        """Draw the bar, the log's end and Cancel; or the last job's message."""
        job = runner.current_job()
        if job is not None:
            self._draw_running(context, job)
            return
        ended = runner.last_job()
        if ended is None:
            return
        box = self.layout.box()
        failed = ended.state is State.FAILED
        box.alert = failed
        icon = {State.FAILED: "ERROR", State.CANCELLED: "CANCEL"}.get(ended.state, "CHECKMARK")
        draw_wrapped(box, context, ended.message, icon=icon, taken=BOX_EDGE)
        row = box.row(align=True)
        row.operator(SCANBACK_OT_dismiss.bl_idname, text="OK")
        if failed:
            row.operator(SCANBACK_OT_show_log.bl_idname)

    def _draw_running(self, context: Any, job: Job) -> None:
        box = self.layout.box()
        progress = job.progress
        if job.state is State.CANCELLING:
            box.label(text=f"{job.title}: ending, what is in hand is left in order", icon="TIME")
        elif progress is None:
            box.label(text=f"{job.title}: starting", icon="TIME")
        else:
            box.label(text=job.title, icon="TIME")
            box.progress(factor=progress.fraction, text=progress.describe())
        column = box.column(align=True)
        column.scale_y = 0.7
        tail = worth_showing(job.log.lines)[-LOG_LINES_SHOWN:]
        for line in last_lines((wrapped(context, line, taken=BOX_EDGE) for line in tail), LOG_LINES_SHOWN):
            column.label(text=line)
        row = box.row(align=True)
        row.operator(SCANBACK_OT_cancel.bl_idname, icon="CANCEL")
        row.operator(SCANBACK_OT_show_log.bl_idname)


class SCANBACK_PT_scan(_StepPanel, bpy.types.Panel):  # type: ignore[misc]  # noqa: N801
    """The first step."""

    bl_idname = "SCANBACK_PT_scan"
    bl_label = "1. Scan"
    bl_order = 1

    def draw(self, context: Any) -> None:
        """Draw what is scanned and how."""
        scene = context.scene
        settings = scene.scanback.scan
        folder = scan_folder(scene)
        draw_settings(self.layout, scene.scanback, "folder")
        if not scene.scanback.folder:
            column = self.layout.column()
            column.active = False
            draw_wrapped(column, context, str(folder))
        draw_settings(self.layout, settings, "subject", "trajectory")
        if settings.trajectory == "ORBIT":
            draw_settings(self.layout, settings, "elevation", "turns")
        if settings.trajectory != "CAMERA":
            draw_length(self.layout, settings, "scan.distance", "Fills the image")
        draw_settings(self.layout, settings, "frames", "width", "height", "preset", "sensor")
        status = status_of(folder)
        reason = reasons.why_not_scan(context)
        if status.frame_count is None and not status.is_there:
            self.draw_button(context, SCANBACK_OT_scan, reason, icon="RENDER_ANIMATION")
            return
        if not status.is_scanned:
            self.layout.label(text=f"{status.frames} of {status.frame_count or '?'} frames are there")
            self.draw_button(context, SCANBACK_OT_resume_scan, reasons.why_no_job(), icon="PLAY")
            if runner.current_job() is not None:
                return  # one grey button says why
        else:
            row = self.layout.row()
            row.label(text=f"{status.frames} frames", icon="CHECKMARK")
            row.operator(SCANBACK_OT_open_folder.bl_idname, icon="FILE_FOLDER")
        self.draw_button(context, SCANBACK_OT_scan, reason, text="Scan Again", overwrite=True)


class SCANBACK_PT_fuse(_StepPanel, bpy.types.Panel):  # type: ignore[misc]  # noqa: N801
    """The second step."""

    bl_idname = "SCANBACK_PT_fuse"
    bl_label = "2. Fuse"
    bl_order = 2

    def draw(self, context: Any) -> None:
        """Draw how frames are fused, and how large the result will be."""
        settings = context.scene.scanback.fuse
        draw_settings(self.layout, settings, "dataset")
        column = self.layout.column()
        draw_length(column, settings, "fuse.voxel_size", automatic_voxel_size(context.scene))
        draw_length(column, settings, "fuse.truncation", automatic_truncation(context.scene))
        draw_length(column, settings, "fuse.depth_max", "No limit")
        draw_settings(self.layout, settings, "every", "mesher", "use_sensor_depth", "device", "live")
        self._draw_estimate(context, settings)
        self.draw_button(context, SCANBACK_OT_fuse, reasons.why_not_fuse(context), icon="MESH_ICOSPHERE")

    def _draw_estimate(self, context: Any, settings: Any) -> None:
        folder = scan_folder(context.scene)
        estimate = known_estimate(dataset_of(context.scene, folder))
        if estimate is None:
            if reasons.why_not_fuse(context) is None:
                self.layout.operator(SCANBACK_OT_estimate.bl_idname, icon="VIEWZOOM")
            return
        unit = metres_per_unit(context.scene)
        voxel_size = settings.voxel_size * unit or estimate.voxel_size
        truncation = settings.truncation * unit or VOXELS_PER_TRUNCATION * voxel_size
        column = self.layout.column(align=True)
        column.label(text=f"Voxels of {length_text(context.scene, voxel_size)}: about")
        column.label(text=f"{estimate.triangles(voxel_size):,} triangles")
        megabytes = max(estimate.megabytes(voxel_size, truncation), 1)
        column.label(text=f"{megabytes:,.0f} MB of memory")


class SCANBACK_PT_locate(_StepPanel, bpy.types.Panel):  # type: ignore[misc]  # noqa: N801
    """The third step."""

    bl_idname = "SCANBACK_PT_locate"
    bl_label = "3. Locate"
    bl_order = 3

    def draw(self, context: Any) -> None:
        """Draw what is located."""
        settings = context.scene.scanback.locate
        extra = {"FRAME": ("frame",), "FILES": ("color_file", "depth_file", "depth_scale")}
        draw_settings(self.layout, settings, "query", *extra.get(settings.query, ()), "refine")
        self.draw_button(context, SCANBACK_OT_locate, reasons.why_not_locate(context), icon="OUTLINER_OB_CAMERA")


class SCANBACK_PT_compare(_StepPanel, bpy.types.Panel):  # type: ignore[misc]  # noqa: N801
    """The fourth step."""

    bl_idname = "SCANBACK_PT_compare"
    bl_label = "4. Compare"
    bl_order = 4

    def draw(self, context: Any) -> None:
        """Draw what is compared, and the numbers."""
        settings = context.scene.scanback.compare
        draw_settings(self.layout, settings, "truth")
        if settings.truth == "OBJECT":
            column = self.layout.column()
            column.use_property_split = True
            column.prop(settings, "original")
        collection = find_shown(context)
        meshes = parts(collection, MESH_PART) if collection is not None else []
        compared = [item for item in meshes if has_errors(item)]
        limit_m = compared[0][NUMBERS_KEY]["limit_m"] if compared else None
        draw_length(self.layout, settings, "compare.limit", automatic_limit(context.scene, limit_m))
        self.draw_button(context, SCANBACK_OT_compare, reasons.why_not_compare(context), icon="COLOR")
        for item in compared:
            self._draw_numbers(context, item)

    def _draw_numbers(self, context: Any, item: Any) -> None:
        numbers = item[NUMBERS_KEY]
        row = self.layout.row(align=True)
        shown = shows_errors(item)
        row.operator(SCANBACK_OT_show_colors.bl_idname, text="Scan", depress=not shown).errors = False
        row.operator(SCANBACK_OT_show_colors.bl_idname, text="Errors", depress=shown).errors = True
        column = self.layout.column(align=True)
        for name, label in (
            ("accuracy_m", "Mesh to original"),
            ("completeness_m", "Original to mesh"),
            ("vertex_most_m", "Farthest vertex"),
            ("limit_m", "Full color at"),
        ):
            if name in numbers:
                split = column.split(factor=0.55)
                split.label(text=label)
                split.label(text=length_text(context.scene, numbers[name]))
        if "fscore" in numbers:
            split = column.split(factor=0.55)
            split.label(text=f"F-score at {length_text(context.scene, numbers['fscore_threshold_m'])}")
            split.label(text=f"{100 * numbers['fscore']:.2f} %")


CLASSES = (SCANBACK_PT_job, SCANBACK_PT_scan, SCANBACK_PT_fuse, SCANBACK_PT_locate, SCANBACK_PT_compare)
register, unregister = bpy.utils.register_classes_factory(CLASSES)
