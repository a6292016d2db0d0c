"""Text in panels: long sentences in lines, lengths in the scene's units."""

import textwrap
from typing import Any

import bpy

PIXELS_PER_LETTER = 7.0


def draw_wrapped(layout: Any, context: Any, text: str, *, icon: str = "NONE", most_lines: int = 12) -> None:
    """Draw a text in as many lines as the region is narrow."""
    region = context.region
    width = region.width if region is not None else 300
    letters = max(20, int(width / context.preferences.system.ui_scale / PIXELS_PER_LETTER) - 4)
    column = layout.column(align=True)
    lines = textwrap.wrap(text, letters) or [""]
    for number, line in enumerate(lines[:most_lines]):
        column.label(text=line, icon=icon if number == 0 else ("NONE" if icon == "NONE" else "BLANK1"))


def length_text(context: Any, metres: float) -> str:
    """Return a length in the words of the scene's units."""
    units = context.scene.unit_settings
    if units.system == "NONE":
        return f"{metres:.4g}"
    return str(bpy.utils.units.to_string(units.system, "LENGTH", metres, precision=4))
