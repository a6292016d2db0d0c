"""The page: table, histograms and pictures in one HTML file, which needs no network."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import jinja2
import numpy as np
from numpy.typing import NDArray

from fusion.pose_benchmark.overlays import Overlay
from fusion.pose_benchmark.summary import Row

TEMPLATE = Path(__file__).with_name("page.html.jinja")
JPEG_QUALITY = 88
"""Of photographs on the page, which would be several times as large as PNG; the files beside it are exact."""


@dataclass(frozen=True, kw_only=True)
class Section:
    """A subject: its rows, a PNG of histograms, and pictures with the titles of their trials."""

    name: str
    description: str
    rows: tuple[Row, ...]
    histograms: bytes
    overlays: tuple[tuple[str, Overlay], ...]


def render_page(sections: Sequence[Section], *, facts: Sequence[tuple[str, str]]) -> str:
    """Return the page as HTML; ``facts`` are versions and settings, listed at its end."""
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    environment.filters["png"] = lambda data: "data:image/png;base64," + base64.b64encode(data).decode()
    environment.filters["jpeg"] = _jpeg_uri
    barred = [row.passed for section in sections for row in section.rows if row.passed is not None]
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    return template.render(sections=sections, facts=facts, passed=sum(barred), bars=len(barred))


def _jpeg_uri(image: NDArray[np.uint8]) -> str:
    """Return an RGB image (height, width, 3) as an address that holds it."""
    encoded, data = cv2.imencode(
        ".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    )
    assert encoded
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()
