"""The page: one HTML file with its pictures inside, which needs no network."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import jinja2

from fusion.report.heat_map import heat_bar
from fusion.report.panels import Figure, Numbers, duration, millimetres
from fusion.report.speed_table import Scene

TEMPLATE = Path(__file__).with_name("page.html.jinja")


@dataclass(frozen=True, kw_only=True)
class Section:
    """A dataset's figures under its name; ``glance`` are the values of its row in the first table, by column."""

    name: str
    description: str
    glance: Numbers
    figures: tuple[Figure, ...]


def render_page(
    sections: Sequence[Section], scenes: Sequence[Scene], *, speed_note: str, facts: Sequence[tuple[str, str]]
) -> str:
    """Return the page as HTML; ``facts`` are versions and settings, listed at its end."""
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(png=_data_uri, duration=duration, millimetres=millimetres)
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    columns = list(dict.fromkeys(name for section in sections for name, _ in section.glance))
    return template.render(
        sections=sections,
        columns=columns,
        scenes=scenes,
        speed_note=speed_note,
        facts=facts,
        heat_bar=heat_bar(),
    )


def encode_png(image: cv2.typing.MatLike) -> bytes:
    """Return an RGB image (height, width, 3) as a PNG file's bytes."""
    encoded, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    assert encoded
    return data.tobytes()


def _data_uri(image: cv2.typing.MatLike) -> str:
    return "data:image/png;base64," + base64.b64encode(encode_png(image)).decode()
