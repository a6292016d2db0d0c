"""Viewports that show what colour a scan's vertices have."""

from collections.abc import Iterator

import bpy

from .scene_collection import LIVE_PART, MESH_PART, PART_KEY
from .view_layers import objects_in

SURFACES = {"MESH", "CURVE", "SURFACE", "FONT", "META", "VOLUME", "POINTCLOUD", "CURVES"}


def suit_shading(scene: bpy.types.Scene) -> None:
    """Let viewports in Solid shading, whose colours nobody has changed, suit what they show of a scene.

    Where our meshes are seen, they show the colours of vertices; and where nothing else is, without the viewport's own
    light, which would darken and whiten them: a scan's colours have the light of the scan, and those of errors are to
    be found in their legend. Other things would be white silhouettes then.
    """
    for layer, shading in _solid_viewports(scene):
        held = [item for item in objects_in(layer) if item.visible_get(view_layer=layer)]
        ours = any(item.get(PART_KEY) in (MESH_PART, LIVE_PART) for item in held)
        others = any(item.type in SURFACES and PART_KEY not in item for item in held)
        if shading.color_type in ("MATERIAL", "VERTEX"):
            shading.color_type = "VERTEX" if ours else "MATERIAL"
        if shading.light in ("STUDIO", "FLAT"):
            shading.light = "FLAT" if ours and not others else "STUDIO"


def _solid_viewports(scene: bpy.types.Scene) -> Iterator[tuple[bpy.types.ViewLayer, bpy.types.View3DShading]]:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D" and window.scene == scene and area.spaces.active.shading.type == "SOLID":
                yield window.view_layer, area.spaces.active.shading
