"""A reconstruction comes into an empty scene: the tab, the button, the file browser, the result."""

import bpy

MODULE = "bl_ext.user_default.scanback"


def steps(window):
    yield from window.install()
    window.seen["enabled"] = MODULE in bpy.context.preferences.addons
    yield 1.0
    window.shot("installed")
    yield from window.open_tab("Scanback")
    window.seen["tab"] = window.region(window.area("VIEW_3D"), "UI").active_panel_category
    window.shot("tab")
    with window.within():
        bpy.ops.scanback.import_reconstruction("INVOKE_DEFAULT")
    yield 1.5
    window.shot("file-browser")
    window.seen["browsers"] = len(bpy.context.window_manager.windows)
