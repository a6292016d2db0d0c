"""A light page to put pictures, words and scales of depth on."""

from functools import lru_cache
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from datagen.preview.depth_colors import DepthScale, scale_strip

PAPER = (255, 255, 255)
INK = (32, 36, 44)
FAINT_INK = (108, 116, 128)
RULE = (206, 210, 216)


@lru_cache
def font(size: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    """Return DejaVu Sans, which matplotlib brings along, ``size`` pixels high."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(mpl.get_data_path()) / "fonts" / "ttf" / name), size)


class Page:
    """A picture that is being composed; coordinates are pixels from the upper left corner."""

    def __init__(self, width: int, height: int) -> None:
        self._image = Image.new("RGB", (width, height), PAPER)
        self._draw = ImageDraw.Draw(self._image)

    def copy(self) -> "Page":
        """Return a page with the same content."""
        other = Page(1, 1)
        other._image = self._image.copy()
        other._draw = ImageDraw.Draw(other._image)
        return other

    def text(
        self,
        x: float,
        y: float,
        words: str,
        *,
        size: int,
        bold: bool = False,
        color: tuple[int, int, int] = INK,
        anchor: str = "ls",
    ) -> None:
        """Write ``words``; ``anchor`` as Pillow's: l, m, r and s (baseline), m, a (top)."""
        self._draw.text((x, y), words, font=font(size, bold=bold), fill=color, anchor=anchor)

    def picture(self, x: int, y: int, pixels: NDArray[np.uint8]) -> None:
        """Put an RGB image (H, W, 3) on the page."""
        self._image.paste(Image.fromarray(np.ascontiguousarray(pixels)), (x, y))

    def frame(self, x: int, y: int, width: int, height: int) -> None:
        """Draw a thin line around a picture."""
        self._draw.rectangle((x - 1, y - 1, x + width, y + height), outline=RULE)

    def horizontal_scale(self, x: int, y: int, length: int, breadth: int, scale: DepthScale, *, size: int) -> None:
        """Draw the colours of depth from near (left) to far with ticks and metres below."""
        self.picture(x, y, scale_strip(length, breadth))
        self.frame(x, y, length, breadth)
        for depth in scale.ticks:
            at = x + round(_share(depth, scale) * (length - 1))
            self._draw.line((at, y + breadth, at, y + breadth + 4), fill=FAINT_INK)
            self.text(at, y + breadth + 7, scale.label(depth), size=size, color=FAINT_INK, anchor="ma")

    def vertical_scale(self, x: int, y: int, length: int, breadth: int, scale: DepthScale, *, size: int) -> None:
        """Draw the colours of depth from far (top) to near with ticks and metres to the right."""
        self.picture(x, y, np.rot90(scale_strip(length, breadth)).copy())
        self.frame(x, y, breadth, length)
        for depth in scale.ticks:
            at = y + length - 1 - round(_share(depth, scale) * (length - 1))
            self._draw.line((x + breadth, at, x + breadth + 4, at), fill=FAINT_INK)
            inside = min(max(at, y + size // 2), y + length - size // 2)
            self.text(x + breadth + 7, inside, scale.label(depth), size=size, color=FAINT_INK, anchor="lm")

    @property
    def image(self) -> Image.Image:
        """The page as Pillow has it."""
        return self._image

    @property
    def pixels(self) -> NDArray[np.uint8]:
        """The page as an RGB array (H, W, 3)."""
        return np.array(self._image)


def fitted(pixels: NDArray[np.uint8], width: int, height: int, *, smooth: bool = False) -> NDArray[np.uint8]:
    """Return an image resized: smaller by averaging; larger smoothly, or by repeating pixels, which invents nothing."""
    enlarging = cv2.INTER_CUBIC if smooth else cv2.INTER_NEAREST
    interpolation = cv2.INTER_AREA if width <= pixels.shape[1] else enlarging
    return cv2.resize(pixels, (width, height), interpolation=interpolation).astype(np.uint8, copy=False)


def _share(depth: float, scale: DepthScale) -> float:
    return (depth - scale.nearest) / (scale.farthest - scale.nearest)
