"""Objects as they would be seen, although a viewport hides them."""

import contextlib
from collections.abc import Iterable, Iterator
from typing import Any

import bpy

from ..results.view_layers import objects_in


@contextlib.contextmanager
def evaluated_as_shown(items: Iterable[bpy.types.Object]) -> Iterator[bpy.types.Depsgraph]:
    """Give the evaluated scene with ``items`` in it: Blender evaluates nothing that it does not have to show.

    What is excluded from the view layer stays out of it.
    """
    layer = bpy.context.view_layer
    held = objects_in(layer)
    there = [item for item in items if item in held]
    closed = [item for item in there if item.hide_get(view_layer=layer)]
    switches: list[Any] = [item for item in there if item.library is None]
    for place in _above(layer.layer_collection, there):
        switches += [place, *([place.collection] if place.collection.library is None else [])]
    disabled = [switch for switch in switches if switch.hide_viewport]
    for switch in disabled:
        switch.hide_viewport = False
    for item in closed:
        item.hide_set(False, view_layer=layer)
    try:
        if closed or disabled:
            layer.update()
        yield bpy.context.evaluated_depsgraph_get()
    finally:
        for item in closed:
            item.hide_set(True, view_layer=layer)
        for switch in disabled:
            switch.hide_viewport = True


def _above(place: bpy.types.LayerCollection, items: list[bpy.types.Object]) -> list[bpy.types.LayerCollection]:
    """Return the places in the tree of collections that hold any of ``items``, from ``place`` down."""
    held = [child for child in place.children if any(item.name in child.collection.all_objects for item in items)]
    return [found for child in held for found in (child, *_above(child, items))]
