"""A video and an animated GIF: colour and depth side by side."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from datagen.atomic_write import replacing
from datagen.camera import PinholeCamera
from datagen.preview.depth_colors import INVALID_COLOR, DepthScale, colored_depth, scale_strip
from datagen.preview.page import FAINT_INK, PAPER, Page, fitted
from datagen.preview.source import PreviewSource, evenly
from datagen.progress import ProgressReporter, silent

VIDEO_PANEL_WIDTH = 560
GIF_PANEL_WIDTH = 288
GIF_MOST_FRAMES = 80
GIF_FRAME_MS = 80
PALETTE_FRAMES = 12
GIF_DEPTH_COLORS = 64
VIDEO_QUALITY = "20"
"""x264's constant rate factor: 18 is nearly lossless to the eye, 23 its default."""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Where things are in a picture of one frame; pixels, both sides of the whole even, as video codecs ask for."""

    panel_width: int
    panel_height: int
    margin: int
    text_size: int

    @property
    def bar_x(self) -> int:
        """Left side of the scale of depth."""
        return 3 * self.margin + 2 * self.panel_width

    @property
    def bar_width(self) -> int:
        """Of the scale without its labels."""
        return max(8, self.text_size)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the whole."""
        width = self.bar_x + self.bar_width + 4 * self.text_size + self.margin // 2
        height = 2 * self.margin + self.panel_height + 2 * self.text_size
        return width + width % 2, height + height % 2


class SideBySide:
    """Pictures of frames with colour, depth and its scale; what all frames share is drawn once."""

    def __init__(self, source: PreviewSource, scale: DepthScale, layout: Layout) -> None:
        self._source, self._scale, self._layout = source, scale, layout
        self.size = layout.size
        self._empty = Page(*layout.size)
        m, size, height = layout.margin, layout.text_size, layout.panel_height
        self._empty.vertical_scale(layout.bar_x, m, height, layout.bar_width, scale, size=size)
        self._baseline = m + height + round(1.6 * size)
        self._empty.text(layout.bar_x, self._baseline, "metres", size=size, color=FAINT_INK)
        name = "depth" if source.depth_layer is None else source.depth_layer.replace("_", " ")
        self._empty.text(2 * m + layout.panel_width, self._baseline, name, size=size, color=FAINT_INK)

    def page(self, frame_id: int, color: NDArray[np.uint8], depth: NDArray[np.float32]) -> Page:
        """Return the picture of a frame; ``color`` RGB, ``depth`` metres."""
        layout, page = self._layout, self._empty.copy()
        panel = layout.panel_width, layout.panel_height
        page.picture(layout.margin, layout.margin, fitted(color, *panel, smooth=True))
        page.picture(2 * layout.margin + panel[0], layout.margin, fitted(colored_depth(depth, self._scale), *panel))
        caption = self._source.caption(frame_id)
        page.text(layout.margin, self._baseline, caption, size=layout.text_size, color=FAINT_INK)
        return page


def write_moving_pictures(
    video: Path, gif: Path, source: PreviewSource, scale: DepthScale, *, progress: ProgressReporter = silent
) -> None:
    """Write an MP4 (H.264, plays in browsers) of all frames and a small GIF of at most ``GIF_MOST_FRAMES``."""
    large = SideBySide(source, scale, _layout(source.dataset.camera, VIDEO_PANEL_WIDTH, margin=16, text_size=15))
    small = SideBySide(source, scale, _layout(source.dataset.camera, GIF_PANEL_WIDTH, margin=8, text_size=11))
    in_gif = set(evenly(source.frame_ids, GIF_MOST_FRAMES))
    palette = _palette(source)
    gif_frames: list[Image.Image] = []
    advance = progress("Video", len(source.frame_ids))
    with replacing(video) as temporary, _encoder(temporary, large, source.frames_per_second) as write:
        for frame_id in source.frame_ids:
            color, depth = source.dataset.color(frame_id), source.depth(frame_id)
            write(large.page(frame_id, color, depth).pixels)
            if frame_id in in_gif:
                gif_frames.append(_indexed(small.page(frame_id, color, depth), palette))
            advance()
    with replacing(gif) as temporary:
        gif_frames[0].save(
            temporary,
            format="GIF",
            save_all=True,
            append_images=gif_frames[1:],
            duration=GIF_FRAME_MS,
            loop=0,
            optimize=False,
        )


def _layout(camera: PinholeCamera, panel_width: int, *, margin: int, text_size: int) -> Layout:
    height = round(panel_width * camera.height / camera.width)
    return Layout(panel_width=panel_width, panel_height=height, margin=margin, text_size=text_size)


def _indexed(page: Page, palette: Image.Image) -> Image.Image:
    """Return a page in a palette's colours, its paper the palette's first: Pillow's search may miss the nearest."""
    found = page.image.quantize(palette=palette, dither=Image.Dither.NONE)
    indices = np.array(found)
    indices[(page.pixels == PAPER).all(axis=-1)] = 0
    exact = Image.fromarray(indices)
    exact.putpalette(palette.getpalette() or [])
    return exact


def _palette(source: PreviewSource) -> Image.Image:
    """Return 256 colours for all frames of a GIF: nothing flickers, and what stays the same costs no bytes.

    The page, the scale of depth and the shades between them have theirs for certain; the frames' own colours share the
    rest.
    """
    fixed = [PAPER, FAINT_INK, INVALID_COLOR]
    fixed += [tuple(np.add(PAPER, FAINT_INK) // 2), tuple(np.add(PAPER, np.multiply(FAINT_INK, 3)) // 4)]
    fixed += [tuple(color) for color in scale_strip(GIF_DEPTH_COLORS, 1)[0]]
    photographs = [fitted(source.dataset.color(i), 160, 120) for i in evenly(source.frame_ids, PALETTE_FRAMES)]
    count = 256 - len(fixed)
    own = Image.fromarray(np.concatenate(photographs)).quantize(count, method=Image.Quantize.MEDIANCUT)
    colors = np.concatenate([np.array(fixed).ravel(), own.getpalette() or []])
    palette = Image.new("P", (1, 1))
    palette.putpalette([int(value) for value in colors])
    return palette


@contextmanager
def _encoder(path: Path, pictures: SideBySide, frames_per_second: float) -> Iterator[Any]:
    """Yield a function that appends an RGB picture (H, W, 3) to the video at ``path``."""
    width, height = pictures.size
    rate = Fraction(frames_per_second).limit_denominator(1001)
    # The index goes to the front of the file, so that a browser begins before it has all of it.
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": VIDEO_QUALITY, "preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"

        def write(pixels: NDArray[np.uint8]) -> None:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))

        yield write
        container.mux(stream.encode(None))
