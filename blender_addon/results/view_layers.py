"""Which objects the view layers of a scene hold."""

import bpy


def objects_in(layer: bpy.types.ViewLayer) -> set[bpy.types.Object]:
    """Return the objects that a view layer holds; one look at all, where looking each up would take the square."""
    for item in layer.id_data.objects[:1]:
        item.hide_get(view_layer=layer)  # a layer's list is behind what was linked until somebody asks for that
    return set(layer.objects)


def layers_shown(scene: bpy.types.Scene) -> list[bpy.types.ViewLayer]:
    """Return the view layers of a scene that windows show, or its first one."""
    shown = {window.view_layer for window in bpy.context.window_manager.windows if window.scene == scene}
    return list(shown) or [scene.view_layers[0]]
