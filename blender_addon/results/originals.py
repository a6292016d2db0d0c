"""What was scanned, in the same place as its reconstruction: one of both is hidden, or they would flicker."""

import json
from collections.abc import Iterable, Sequence

import bpy

from .scene_collection import MESH_PART, is_ours, parts
from .view_layers import layers_shown, objects_in

ORIGINALS_KEY = "scanback_originals"
"""Custom property of a reconstruction's collection: the names of the objects that were scanned, as JSON."""


def note_originals(collection: bpy.types.Collection, names: Iterable[str]) -> None:
    """Keep the names of the objects whose place a reconstruction takes, beside those that it has."""
    known = {*_names(collection), *names}
    if known:
        collection[ORIGINALS_KEY] = json.dumps(sorted(known))


def originals_of(scene: bpy.types.Scene, collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Return those objects of the scene that the reconstruction ``collection`` was made of."""
    return [item for item in named(scene, _names(collection)) if not is_ours(item)]


def named(scene: bpy.types.Scene, names: Iterable[str]) -> list[bpy.types.Object]:
    """Return the objects of a scene that have one of ``names``."""
    wanted = set(names)
    return [item for item in scene.objects if item.name in wanted] if wanted else []


def show_sides(
    scene: bpy.types.Scene, collection: bpy.types.Collection, *, original: bool, reconstruction: bool
) -> None:
    """Show or hide, in the viewports, what was scanned and the mesh that was made of it."""
    set_hidden(scene, originals_of(scene, collection), hidden=not original)
    set_hidden(scene, parts(collection, MESH_PART), hidden=not reconstruction)


def is_shown(scene: bpy.types.Scene, items: Sequence[bpy.types.Object]) -> bool:
    """Tell whether a viewport shows any of ``items``."""
    for layer in layers_shown(scene):
        held = objects_in(layer)
        if any(item in held and item.visible_get(view_layer=layer) for item in items):
            return True
    return False


def set_hidden(scene: bpy.types.Scene, items: Sequence[bpy.types.Object], *, hidden: bool) -> list[bpy.types.Object]:
    """Close or open the eyes that objects have in the outliner; returns those for which that was a change."""
    changed = {}
    for layer in layers_shown(scene):
        held = objects_in(layer)
        # All are asked before the first is changed: Blender brings the layer's list up to date after each change.
        for item in [item for item in items if item in held and item.hide_get(view_layer=layer) != hidden]:
            item.hide_set(hidden, view_layer=layer)
            changed[item.name] = item
    return list(changed.values())


def _names(collection: bpy.types.Collection) -> list[str]:
    try:
        names = json.loads(collection.get(ORIGINALS_KEY, "[]"))
    except (ValueError, TypeError):  # somebody wrote something else there
        return []
    return [str(name) for name in names] if isinstance(names, list) else []
