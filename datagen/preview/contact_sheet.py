"""A contact sheet: frames spread over a dataset, colour above depth."""

from pathlib import Path

from datagen.atomic_write import replacing
from datagen.preview.depth_colors import DepthScale, colored_depth
from datagen.preview.page import FAINT_INK, Page, fitted
from datagen.preview.source import PreviewSource, evenly
from datagen.progress import ProgressReporter, silent

SHEET_WIDTH = 1680
MARGIN = 40
GAP = 20
HEADER = 104
CAPTION = 34
BETWEEN = 4
"""Pixels between a frame's colour and its depth."""


def write_contact_sheet(
    path: Path,
    source: PreviewSource,
    scale: DepthScale,
    *,
    frames: int = 12,
    columns: int = 4,
    progress: ProgressReporter = silent,
) -> None:
    """Write a PNG with at most ``frames`` frames at even distances, ``columns`` a row, and the scale of depth."""
    shown = evenly(source.frame_ids, frames)
    columns = min(columns, len(shown))
    rows = -(-len(shown) // columns)
    camera = source.dataset.camera
    width = (SHEET_WIDTH - 2 * MARGIN - 3 * GAP) // 4
    height = round(width * camera.height / camera.width)
    cell = 2 * height + BETWEEN + CAPTION
    page_width = max(2 * MARGIN + columns * width + (columns - 1) * GAP, 2 * MARGIN + 3 * width)
    page = Page(page_width, MARGIN + HEADER + rows * cell + (rows - 1) * GAP + MARGIN // 2)
    _header(page, page_width, source, scale)
    advance = progress("Contact sheet", len(shown))
    for i, frame_id in enumerate(shown):
        x = MARGIN + (i % columns) * (width + GAP)
        y = MARGIN + HEADER + (i // columns) * (cell + GAP)
        depth = colored_depth(source.depth(frame_id), scale)
        page.picture(x, y, fitted(source.dataset.color(frame_id), width, height, smooth=True))
        page.picture(x, y + height + BETWEEN, fitted(depth, width, height))
        for top in (y, y + height + BETWEEN):
            page.frame(x, top, width, height)
        page.text(x, y + 2 * height + BETWEEN + 22, source.caption(frame_id), size=15, color=FAINT_INK)
        advance()
    with replacing(path) as temporary:
        page.image.save(temporary, format="PNG")


def _header(page: Page, page_width: int, source: PreviewSource, scale: DepthScale) -> None:
    camera, dataset = source.dataset.camera, source.dataset
    page.text(MARGIN, MARGIN + 26, dataset.folder.resolve().name, size=30, bold=True)
    facts = f"{len(source.frame_ids)} frames · {camera.width} × {camera.height} px · {dataset.format_name}"
    page.text(MARGIN, MARGIN + 58, facts, size=17, color=FAINT_INK)
    length = min(420, page_width // 3)
    x = page_width - MARGIN - length
    name = "depth" if source.depth_layer is None else source.depth_layer.replace("_", " ")
    page.text(x, MARGIN + 14, f"{name} in metres, grey: none", size=15, color=FAINT_INK)
    page.horizontal_scale(x, MARGIN + 24, length, 16, scale, size=15)
