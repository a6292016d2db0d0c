"""What was scanned, in the same place as its reconstruction: one of both is hidden, or they would flicker.

The scene keeps pointers to the objects, which stay theirs when they are renamed, saved or undone. They are kept there
and not in the reconstruction's collection, which would take its originals along into other files.
"""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import bpy

from ..scan_folder import relative_path
from .scene_collection import MESH_PART, folder_of, is_ours, parts
from .view_layers import layers_shown, objects_in


def note_originals(
    scene: bpy.types.Scene, folder: Path, items: Iterable[bpy.types.Object], *, anew: bool = False
) -> None:
    """Keep objects of a scene as those whose place the reconstruction in ``folder`` takes, beside those known.

    Where it is made ``anew``, others are so no more, and shown again.
    """
    items = list(items)
    known = originals_of(scene, folder)
    if anew:
        others = [item for item in known if item not in items]
        set_hidden(scene, others, hidden=False)
        keep_from_renders(scene, others, kept=False)
        stale = _texts(scene, folder)
        _forget(scene, lambda entry: entry.folder in stale and entry.item not in items)
    for item in items:
        if item not in known and not is_ours(item):
            entry = scene.scanback.originals.add()
            entry.item, entry.folder = item, relative_path(folder)


def originals_of(scene: bpy.types.Scene, folder: Path | None) -> list[bpy.types.Object]:
    """Return those objects of the scene that the reconstruction in ``folder`` was made of."""
    entries = _entries(scene, folder)
    held = set(scene.objects) if entries else set()
    return [entry.item for entry in entries if entry.item in held]


def forget_deleted(scene: bpy.types.Scene) -> None:
    """Let go of objects that are in no scene any more: the pointers are all that keeps them in the file."""
    _forget(scene, lambda entry: entry.item is None or not entry.item.users_scene)
    chosen = scene.scanback.compare.original
    if chosen is not None and not chosen.users_scene:
        scene.scanback.compare.original = None


def named(scene: bpy.types.Scene, names: Iterable[str]) -> list[bpy.types.Object]:
    """Return the objects of a scene that have one of ``names``."""
    wanted = set(names)
    return [item for item in scene.objects if item.name in wanted] if wanted else []


def show_sides(
    scene: bpy.types.Scene, collection: bpy.types.Collection, *, original: bool, reconstruction: bool
) -> None:
    """Show or hide, in viewports and renders, what was scanned and the mesh that was made of it."""
    both = (originals_of(scene, folder_of(collection)), original), (parts(collection, MESH_PART), reconstruction)
    for items, shown in both:
        set_hidden(scene, items, hidden=not shown)
        keep_from_renders(scene, items, kept=not shown)


def is_shown(scene: bpy.types.Scene, items: Sequence[bpy.types.Object]) -> bool:
    """Tell whether a viewport shows any of ``items``."""
    for layer in layers_shown(scene):
        held = objects_in(layer)
        if any(item in held and item.visible_get(view_layer=layer) for item in items):
            return True
    return False


def set_hidden(scene: bpy.types.Scene, items: Sequence[bpy.types.Object], *, hidden: bool) -> list[bpy.types.Object]:
    """Close or open the eyes that objects have in the outliner; returns those for which that was a change."""
    changed: dict[bpy.types.Object, None] = {}
    for layer in layers_shown(scene):
        held = objects_in(layer)
        # All are asked before the first is changed: Blender brings the layer's list up to date after each change.
        for item in [item for item in items if item in held and item.hide_get(view_layer=layer) != hidden]:
            item.hide_set(hidden, view_layer=layer)
            changed[item] = None
    return list(changed)


def keep_from_renders(
    scene: bpy.types.Scene, items: Iterable[bpy.types.Object], *, kept: bool
) -> list[bpy.types.Object]:
    """Keep originals and our own objects from a scene's renders, or no more; returns those for which that is a change.

    Originals that do not render by their user's choice never do. Those of several scenes go on to render: Blender knows
    no way to keep an object from one scene's renders alone.
    """
    entries: dict[bpy.types.Object, list[Any]] = {}
    for entry in scene.scanback.originals:
        entries.setdefault(entry.item, []).append(entry)
    changed = []
    for item in items:
        mine = entries.get(item, [])
        is_free = is_ours(item) or (len(item.users_scene) == 1 if kept else _are_kept(mine))
        if item.hide_render != kept and is_free:
            item.hide_render = kept
            changed.append(item)
            for entry in mine:
                entry.is_kept_from_renders = kept
    return changed


def kept_from_renders(scene: bpy.types.Scene) -> set[bpy.types.Object]:
    """Return the originals that do not render because their reconstruction does."""
    return {entry.item for entry in scene.scanback.originals if entry.is_kept_from_renders and entry.item is not None}


def keep_again(scene: bpy.types.Scene) -> None:
    """Keep from renders what belongs to other files: it does so no more when this file is opened."""
    for item in kept_from_renders(scene):
        if item.library is not None or item.override_library is not None:
            item.hide_render = True


def _are_kept(entries: Sequence[Any]) -> bool:
    return any(entry.is_kept_from_renders for entry in entries)


def _entries(scene: bpy.types.Scene, folder: Path | None) -> list[Any]:
    texts = _texts(scene, folder)
    return [entry for entry in scene.scanback.originals if entry.folder in texts]


def _texts(scene: bpy.types.Scene, folder: Path | None) -> set[str]:
    """Return the ways in which the scene's originals name a folder."""
    if folder is None:
        return set()
    texts = {entry.folder for entry in scene.scanback.originals}
    return {text for text in texts if Path(bpy.path.abspath(text)).resolve() == folder.resolve()}


def _forget(scene: bpy.types.Scene, is_lost: Callable[[Any], bool]) -> None:
    originals = scene.scanback.originals
    for index in reversed([index for index, entry in enumerate(originals) if is_lost(entry)]):
        originals.remove(index)
