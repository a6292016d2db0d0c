"""The legend of the error colours, drawn over the viewport."""

from typing import Any

import bpy
import numpy as np

from ..operators.shown_collection import find_shown
from ..results.error_colors import NUMBERS_KEY, heat_srgb, shows_errors
from ..results.scene_collection import MESH_PART, parts
from .wrapped_text import length_text

WIDTH, HEIGHT, LEFT, BOTTOM = 240, 14, 24, 40
STEPS = 48
_handles: list[Any] = []


def legend_labels(context: Any) -> tuple[str, str] | None:
    """Return the words at both ends of the bar, None where no mesh shows its errors."""
    collection = find_shown(context)
    shown = [item for item in parts(collection, MESH_PART) if shows_errors(item)] if collection is not None else []
    if not shown or shown[0].hide_get():
        return None
    limit = length_text(context, shown[0][NUMBERS_KEY]["limit_m"])
    return length_text(context, 0.0), f"{limit} or more from the original"


def _draw() -> None:
    import blf  # type: ignore[import-not-found]  # noqa: PLC0415 - these two are there with an interface alone
    import gpu  # type: ignore[import-not-found]  # noqa: PLC0415
    from gpu_extras.batch import batch_for_shader  # type: ignore[import-not-found]  # noqa: PLC0415

    labels = legend_labels(bpy.context)
    if labels is None:
        return
    scale = bpy.context.preferences.system.ui_scale
    edges = LEFT * scale + WIDTH * scale * np.arange(STEPS + 1) / STEPS
    low, high = BOTTOM * scale, (BOTTOM + HEIGHT) * scale
    colors = heat_srgb((np.arange(STEPS) + 0.5) / STEPS)
    places, tints, triangles = [], [], []
    for i in range(STEPS):
        places += [(edges[i], low), (edges[i + 1], low), (edges[i + 1], high), (edges[i], high)]
        tints += [tuple(colors[i])] * 4
        triangles += [(4 * i, 4 * i + 1, 4 * i + 2), (4 * i, 4 * i + 2, 4 * i + 3)]
    shader = gpu.shader.from_builtin("FLAT_COLOR")
    batch_for_shader(shader, "TRIS", {"pos": places, "color": tints}, indices=triangles).draw(shader)
    blf.size(0, 12 * scale)
    blf.color(0, 1, 1, 1, 1)
    blf.enable(0, blf.SHADOW)
    blf.shadow(0, 3, 0, 0, 0, 1)
    for text, x in ((labels[0], edges[0]), (labels[1], edges[-1] - 40 * scale)):
        blf.position(0, x, low - 16 * scale, 0)
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
