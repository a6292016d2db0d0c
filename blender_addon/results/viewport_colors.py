"""Viewports that show what colour a scan's vertices have."""

import bpy


def show_vertex_colors() -> None:
    """Let viewports in Solid shading, whose colours nobody has changed, show the colours of vertices."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                shading = area.spaces.active.shading
                if shading.type == "SOLID" and shading.color_type == "MATERIAL":
                    shading.color_type = "VERTEX"
