"""Viewports that show what colour a scan's vertices have."""

import bpy


def show_vertex_colors() -> None:
    """Let viewports in Solid shading, whose colours nobody has changed, show the colours of vertices.

    Without highlights, which would whiten them: a scan's colours have the light of the scan, those of errors mean
    something.
    """
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                shading = area.spaces.active.shading
                if shading.type == "SOLID" and shading.color_type == "MATERIAL":
                    shading.color_type = "VERTEX"
                    shading.show_specular_highlight = False
