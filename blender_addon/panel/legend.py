"""The legend of the error colours, drawn over the viewport."""

from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np

from ..operators.shown_collection import find_shown
from ..results.error_colors import NUMBERS_KEY, heat_srgb, shows_errors
from ..results.originals import is_shown
from ..results.scene_collection import MESH_PART, parts
from ..results.scene_units import length_text

WIDTH, HEIGHT, LEFT, BOTTOM = 240, 14, 24, 40
STEPS = 48
TITLE = "Distance from the original"
_handles: list[Any] = []
_prepared: list[bool] = []


@dataclass(frozen=True, kw_only=True)
class Legend:
    """The words at the left and at the right end of the bar."""

    low: str
    high: str


def legend_of(context: Any) -> Legend | None:
    """Return what is written at the bar, None where no mesh that is shown has the colors of its errors."""
    collection = find_shown(context)
    meshes = parts(collection, MESH_PART) if collection is not None else []
    shown = [item for item in meshes if shows_errors(item) and is_shown(context.scene, [item])]
    if not shown:
        return None
    limit = length_text(context.scene, shown[0][NUMBERS_KEY]["limit_m"])
    return Legend(low="0", high=f"{limit} and more")


def shows_colors(space: Any) -> bool:
    """Tell whether a viewport shows overlays, and the colors of vertices or materials that have them."""
    if not space.overlay.show_overlays:
        return False
    shading = space.shading
    return shading.type in ("MATERIAL", "RENDERED") or (shading.type == "SOLID" and shading.color_type == "VERTEX")


def _draw() -> None:
    if not _prepared:
        # A driver compiles what draws the bar as it draws it first, some 60 ms without a graphics card: better now, out
        # of sight, than while a job runs.
        _prepared.append(True)
        _draw_bar(bpy.context.preferences.system.ui_scale, left=-2 * WIDTH)
    space = bpy.context.space_data
    legend = legend_of(bpy.context) if space is not None and shows_colors(space) else None
    if legend is not None:
        _draw_bar(bpy.context.preferences.system.ui_scale)
        _draw_words(bpy.context.preferences.system.ui_scale, legend)


def _draw_bar(scale: float, *, left: float = LEFT) -> None:
    import gpu  # type: ignore[import-not-found]  # noqa: PLC0415 - these are there with an interface alone
    from gpu_extras.batch import batch_for_shader  # type: ignore[import-not-found]  # noqa: PLC0415

    edges = left * scale + WIDTH * scale * np.arange(STEPS + 1) / STEPS
    low, high = BOTTOM * scale, (BOTTOM + HEIGHT) * scale
    colors = heat_srgb((np.arange(STEPS) + 0.5) / STEPS)
    places, tints, triangles = [], [], []
    for i in range(STEPS):
        places += [(edges[i], low), (edges[i + 1], low), (edges[i + 1], high), (edges[i], high)]
        tints += [tuple(colors[i])] * 4
        triangles += [(4 * i, 4 * i + 1, 4 * i + 2), (4 * i, 4 * i + 2, 4 * i + 3)]
    shader = gpu.shader.from_builtin("FLAT_COLOR")
    batch_for_shader(shader, "TRIS", {"pos": places, "color": tints}, indices=triangles).draw(shader)


def _draw_words(scale: float, legend: Legend) -> None:
    import blf  # type: ignore[import-not-found]  # noqa: PLC0415

    blf.size(0, 12 * scale)
    blf.color(0, 1, 1, 1, 1)
    blf.enable(0, blf.SHADOW)
    blf.shadow(0, 3, 0, 0, 0, 1)
    left, right = LEFT * scale, (LEFT + WIDTH) * scale
    below, above = (BOTTOM - 16) * scale, (BOTTOM + HEIGHT + 7) * scale
    after = right - blf.dimensions(0, legend.high)[0]
    for text, x, y in ((TITLE, left, above), (legend.low, left, below), (legend.high, after, below)):
        blf.position(0, x, y, 0)
        blf.draw(0, text)
    blf.disable(0, blf.SHADOW)


def register() -> None:
    """Draw it over all viewports from now on."""
    if not bpy.app.background:
        _handles.append(bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL"))


def unregister() -> None:
    """Draw it no more."""
    while _handles:
        bpy.types.SpaceView3D.draw_handler_remove(_handles.pop(), "WINDOW")
    _prepared.clear()
