"""Why a step cannot run yet, in words; None where it can."""

from functools import cache
from typing import Any

from ..jobs import runner
from ..jobs.command import missing_packages
from ..scan_folder import scan_folder
from .fuse_source import dataset_of
from .scan_source import why_nothing_to_scan
from .status import Status, status_of


def why_no_job() -> str | None:
    """Say why no job at all can begin."""
    job = runner.current_job()
    if job is not None:
        return f"{job.title} is running"
    missing = _missing()
    if missing:
        return f"Not installed: {', '.join(missing)}; install the extension for your platform from its zip"
    return None


def why_not_scan(context: Any) -> str | None:
    """Say why nothing can be scanned."""
    settings = context.scene.scanback.scan
    if settings.trajectory == "CAMERA" and context.scene.camera is None:
        return "The scene has no camera to follow"
    nothing = why_nothing_to_scan(context.scene, context.view_layer.objects.active, settings.subject)
    return nothing or why_no_job()


def why_not_fuse(context: Any) -> str | None:
    """Say why nothing can be fused."""
    status = _status(context)
    if status.frame_count is None:
        return "Scan first, or choose a dataset"
    if not status.is_scanned:
        return f"The scan has {status.frames} of {status.frame_count} frames; go on with it"
    if context.scene.scanback.fuse.use_sensor_depth and not status.has_sensor:
        return "The dataset has no simulated sensor's depth"
    return why_no_job()


def why_not_locate(context: Any) -> str | None:
    """Say why nothing can be located."""
    settings = context.scene.scanback.locate
    if not _status(context).is_fused:
        return "Fuse first"
    if settings.query == "FILES" and not settings.depth_file:
        return "Choose a depth image"
    if settings.query == "CAMERA" and context.scene.camera is None:
        return "The scene has no camera"
    return why_no_job()


def why_not_compare(context: Any) -> str | None:
    """Say why nothing can be compared."""
    settings = context.scene.scanback.compare
    status = _status(context)
    if not status.is_fused:
        return "Fuse first"
    if settings.truth == "DATASET" and not status.has_truth:
        return "The dataset keeps no original; compare with an object"
    if settings.truth == "OBJECT" and settings.object_name not in context.scene.objects:
        return "Choose the object to compare with"
    return why_no_job()


def _status(context: Any) -> Status:
    folder = scan_folder(context.scene)
    return status_of(folder, dataset_of(context.scene, folder))


@cache
def _missing() -> list[str]:
    return missing_packages()
