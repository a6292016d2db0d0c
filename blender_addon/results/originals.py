"""What was scanned, in the same place as its reconstruction: one of both is hidden, or they would flicker."""

import json
from collections.abc import Iterable

import bpy

from .scene_collection import MESH_PART, is_ours, parts
from .view_layers import is_in, layers_shown

ORIGINALS_KEY = "scanback_originals"
"""Custom property of a reconstruction's collection: the names of the objects that were scanned, as JSON."""


def note_originals(collection: bpy.types.Collection, names: Iterable[str]) -> None:
    """Keep the names of the objects whose place a reconstruction takes, beside those that it has."""
    known = {*_names(collection), *names}
    if known:
        collection[ORIGINALS_KEY] = json.dumps(sorted(known))


def originals_of(scene: bpy.types.Scene, collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Return those objects of the scene that the reconstruction ``collection`` was made of."""
    found = (scene.objects.get(name) for name in _names(collection))
    return [item for item in found if item is not None and not is_ours(item)]


def show_sides(
    scene: bpy.types.Scene, collection: bpy.types.Collection, *, original: bool, reconstruction: bool
) -> None:
    """Show or hide, in the viewports, what was scanned and the mesh that was made of it."""
    set_hidden(scene, originals_of(scene, collection), hidden=not original)
    set_hidden(scene, parts(collection, MESH_PART), hidden=not reconstruction)


def is_shown(scene: bpy.types.Scene, items: Iterable[bpy.types.Object]) -> bool:
    """Tell whether a viewport shows any of ``items``."""
    layers = layers_shown(scene)
    return any(is_in(item, layer) and item.visible_get(view_layer=layer) for item in items for layer in layers)


def set_hidden(scene: bpy.types.Scene, items: Iterable[bpy.types.Object], *, hidden: bool) -> list[bpy.types.Object]:
    """Close or open the eyes that objects have in the outliner; returns those for which that was a change."""
    changed, chosen = {}, list(items)
    for layer in layers_shown(scene):
        for item in chosen:
            if is_in(item, layer) and item.hide_get(view_layer=layer) != hidden:
                item.hide_set(hidden, view_layer=layer)
                changed[item.name] = item
    return list(changed.values())


def _names(collection: bpy.types.Collection) -> list[str]:
    try:
        names = json.loads(collection.get(ORIGINALS_KEY, "[]"))
    except (ValueError, TypeError):  # somebody wrote something else there
        return []
    return [str(name) for name in names] if isinstance(names, list) else []
