"""Viewports that show what colour a scan's vertices have."""

import bpy


def show_vertex_colors() -> None:
    """Let viewports in Solid shading, whose colours nobody has changed, show the colours of vertices as they are.

    Without the viewport's own light, which would darken and whiten them: a scan's colours have the light of the scan,
    and those of errors are to be found in their legend.
    """
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                shading = area.spaces.active.shading
                if shading.type == "SOLID" and shading.color_type == "MATERIAL":
                    shading.color_type = "VERTEX"
                    shading.light = "FLAT"
