"""Which objects the view layers of a scene hold."""

import bpy


def is_in(item: bpy.types.Object, layer: bpy.types.ViewLayer) -> bool:
    """Tell whether a view layer holds an object."""
    item.hide_get(view_layer=layer)  # a layer's own list is behind what was linked until it is asked for something
    return bool(layer.objects.get(item.name) == item)


def layers_shown(scene: bpy.types.Scene) -> list[bpy.types.ViewLayer]:
    """Return the view layers of a scene that windows show, or its first one."""
    shown = {window.view_layer for window in bpy.context.window_manager.windows if window.scene == scene}
    return list(shown) or [scene.view_layers[0]]
