"""Text in panels: long sentences in as many lines as the panel is narrow."""

import re
from collections.abc import Callable
from typing import Any

PANEL_EDGE, BOX_EDGE, ICON = 56.0, 14.0, 26.0
"""What panels, boxes and icons take of a region's width, in pixels at a scale of 1."""
LEAST_WIDTH = 60.0
_PIECES = re.compile(r"\S+\s*")


def wrap(text: str, width: float, measure: Callable[[str], float]) -> list[str]:
    """Return ``text`` in lines that ``measure`` finds no wider than ``width``; words that are wider are broken.

    A line has one letter at least, however wide that is. Blanks where lines are broken are dropped.
    """
    lines, line = [], ""
    for piece in _PIECES.findall(text):
        if measure((line + piece).rstrip()) <= width:
            line += piece
            continue
        if line:
            lines.append(line.rstrip())
        line = piece
        while len(line.rstrip()) > 1 and measure(line.rstrip()) > width:
            fitting = _fitting(line.rstrip(), width, measure)
            lines.append(line[:fitting])
            line = line[fitting:]
    return [*lines, line.rstrip()] if line.strip() or not lines else lines


def wrapped(context: Any, text: str, *, taken: float = 0.0) -> list[str]:
    """Return a text in lines that fit the region's panels, less ``taken`` pixels at a scale of 1."""
    import blf  # type: ignore[import-not-found]  # noqa: PLC0415 - it measures with an interface alone

    system, style = context.preferences.system, context.preferences.ui_styles[0].widget
    blf.size(0, style.points * system.ui_scale)
    width = _width_of(context.region) - (PANEL_EDGE + taken) * system.ui_scale
    return wrap(text, max(width, LEAST_WIDTH * system.ui_scale), lambda line: float(blf.dimensions(0, line)[0]))


def draw_wrapped(
    layout: Any, context: Any, text: str, *, icon: str = "NONE", most_lines: int = 12, taken: float = 0.0
) -> None:
    """Draw a text in as many lines as it needs; ``taken`` is the width that surroundings take, at a scale of 1."""
    column = layout.column(align=True)
    lines = wrapped(context, text, taken=taken + (ICON if icon != "NONE" else 0.0))
    if len(lines) > most_lines:
        lines = [*lines[: most_lines - 1], lines[most_lines - 1][:-1] + "…"]
    for number, line in enumerate(lines):
        column.label(text=line, icon=icon if number == 0 or icon == "NONE" else "BLANK1")


def _width_of(region: Any) -> float:
    """Return a region's width in the pixels of its panels, which can be zoomed."""
    view = region.view2d
    return float(view.region_to_view(region.width, 0)[0] - view.region_to_view(0, 0)[0])


def _fitting(word: str, width: float, measure: Callable[[str], float]) -> int:
    """Return how many letters of a word fit, one at least."""
    low, high = 1, len(word)
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if measure(word[:middle]) <= width else (low, middle - 1)
    return low
