"""All pictures of a dataset at once."""

from pathlib import Path

from datagen.atomic_write import remove_unfinished, require_writable
from datagen.dataset import Dataset
from datagen.preview.contact_sheet import write_contact_sheet
from datagen.preview.moving_pictures import write_moving_pictures
from datagen.preview.source import preview_source
from datagen.preview.trajectory_plot import write_trajectory_plot
from datagen.progress import ProgressReporter, silent

CONTACT_SHEET_FILE = "contact_sheet.png"
VIDEO_FILE = "video.mp4"
GIF_FILE = "animation.gif"
TRAJECTORY_FILE = "trajectory.png"


def make_preview(
    dataset: Dataset,
    out: Path,
    *,
    frame_ids: tuple[int, ...] | None = None,
    depth_layer: str | None = None,
    progress: ProgressReporter = silent,
) -> tuple[int, tuple[Path, ...]]:
    """Write contact sheet, video, GIF and plot of the path into the folder ``out``; return the frames shown, the files.

    Frames (all, or ``frame_ids``) that lack a file are left out. ``depth_layer`` is shown in place of the depth. Raises
    InputError where no frame is complete, an image cannot be read or ``out`` cannot be written to.
    """
    require_writable(out)
    source = preview_source(dataset, frame_ids or dataset.frame_ids, depth_layer=depth_layer)
    scale = source.scale()
    remove_unfinished(out)
    sheet, video, gif, plot = (out / name for name in (CONTACT_SHEET_FILE, VIDEO_FILE, GIF_FILE, TRAJECTORY_FILE))
    write_contact_sheet(sheet, source, scale, progress=progress)
    write_trajectory_plot(plot, source, progress=progress)
    write_moving_pictures(video, gif, source, scale, progress=progress)
    return len(source.frame_ids), (sheet, plot, video, gif)
