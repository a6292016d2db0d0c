"""Errors of a mesh as colours of its vertices, with the numbers that explain them."""

from collections.abc import Mapping

import bpy
import numpy as np
from numpy.typing import NDArray

from ..errors import ReconstructionError
from .mesh_import import COLOR_ATTRIBUTE

ERROR_COLORS = "Scanback error"
ERROR_METRES = "scanback_error_m"
NUMBERS_KEY = "scanback_errors"
"""Custom property of the mesh's object: limit_m, mean_m, and what else is known, all numbers."""
COMMON_SHARE = 95.0
VIRIDIS = ("440154", "482475", "414487", "355f8d", "2a788e", "21918c", "22a884", "44bf70", "7ad151", "bddf26", "fde725")
"""sRGB at every tenth of the way from no error to the limit and beyond."""


def heat_srgb(shares: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return sRGB colours (N, 4) from 0 to 1 for shares (N,) of the limit, dark for 0, bright from 1 on."""
    anchors = np.array([[int(color[i : i + 2], 16) / 255 for i in (0, 2, 4)] for color in VIRIDIS])
    places = np.linspace(0, 1, len(anchors))
    colors = np.ones((len(shares), 4), np.float32)
    for channel in range(3):
        colors[:, channel] = np.interp(shares, places, anchors[:, channel])
    return colors


def put_errors(
    item: bpy.types.Object, distances_m: NDArray[np.float32], *, limit_m: float, numbers: Mapping[str, float]
) -> None:
    """Give a mesh object its vertices' errors (N,), as metres and as colours up to ``limit_m``, and show them.

    A limit of 0 is what ``COMMON_SHARE`` percent stay below. Raises ReconstructionError where the mesh has other
    vertices: it was edited.
    """
    data = item.data
    if len(data.vertices) != len(distances_m):
        raise ReconstructionError(
            f"{item.name} has {len(data.vertices):,} vertices, {len(distances_m):,} were compared: it was edited; "
            "import the reconstruction again"
        )
    limit = limit_m or float(np.percentile(distances_m, COMMON_SHARE)) or 1e-6
    for name, kind in ((ERROR_METRES, "FLOAT"), (ERROR_COLORS, "BYTE_COLOR")):
        if name in data.attributes:
            data.attributes.remove(data.attributes[name])
        data.attributes.new(name, kind, "POINT")
    data.attributes[ERROR_METRES].data.foreach_set("value", distances_m)
    data.attributes[ERROR_COLORS].data.foreach_set("color_srgb", heat_srgb(distances_m / limit).ravel())
    item[NUMBERS_KEY] = {
        "limit_m": limit,
        "vertex_mean_m": float(distances_m.mean()),
        "vertex_most_m": float(distances_m.max()),
        **numbers,
    }
    show_colors(item, errors=True)


def has_errors(item: bpy.types.Object) -> bool:
    """Tell whether a mesh object was compared."""
    return NUMBERS_KEY in item and ERROR_COLORS in item.data.attributes


def shows_errors(item: bpy.types.Object) -> bool:
    """Tell whether a mesh object shows its errors now."""
    active = item.data.color_attributes.active_color
    return has_errors(item) and active is not None and active.name == ERROR_COLORS


def show_colors(item: bpy.types.Object, *, errors: bool) -> None:
    """Let a mesh object show its errors, or what was scanned. Raises ReconstructionError for errors it has not."""
    if errors and not has_errors(item):
        raise ReconstructionError(f"{item.name} was not compared yet; compare it first")
    name = ERROR_COLORS if errors else COLOR_ATTRIBUTE
    attributes = item.data.color_attributes
    if name in attributes:
        attributes.active_color = attributes[name]
        attributes.render_color_index = attributes.find(name)
    for slot in item.material_slots:
        if slot.material is not None and slot.material.node_tree is not None:
            for node in slot.material.node_tree.nodes:
                if node.type == "VERTEX_COLOR" and node.layer_name in (COLOR_ATTRIBUTE, ERROR_COLORS):
                    node.layer_name = name
    item.data.update()
