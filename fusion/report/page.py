"""The page: one HTML file with its pictures inside, which needs no network."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import jinja2

from fusion.report.figures import Figure
from fusion.report.heat_map import heat_bar

TEMPLATE = Path(__file__).with_name("page.html.jinja")


@dataclass(frozen=True, kw_only=True)
class Section:
    """A dataset's figures under its name."""

    name: str
    description: str
    figures: tuple[Figure, ...]


@dataclass(frozen=True, kw_only=True)
class Speed:
    """A row of table I; the time is that of finding blocks and integrating, ``source`` ours or paper."""

    scene: str
    device: str
    frames: int
    frames_per_second: float
    source: str


def render_page(sections: Sequence[Section], speeds: Sequence[Speed], *, facts: Sequence[tuple[str, str]]) -> str:
    """Return the page as HTML; ``facts`` are versions and settings, listed at its end."""
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    environment.filters["png"] = _data_uri
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    return template.render(sections=sections, speeds=speeds, facts=facts, heat_bar=heat_bar())


def encode_png(image: cv2.typing.MatLike) -> bytes:
    """Return an RGB image (height, width, 3) as a PNG file's bytes."""
    encoded, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    assert encoded
    return data.tobytes()


def _data_uri(image: cv2.typing.MatLike) -> str:
    return "data:image/png;base64," + base64.b64encode(encode_png(image)).decode()
