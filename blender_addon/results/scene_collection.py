"""The collection that holds a reconstruction in a scene, and what of it is ours to replace."""

import os
from collections.abc import Iterable
from pathlib import Path

import bpy

from .wire_curve import materials_of_tubes, tubes_of

FOLDER_KEY = "scanback_folder"
"""Custom property of a reconstruction's collection: its folder. Names may be changed by the user, this stays."""
PART_KEY = "scanback_part"
"""Custom property of all that we put into such a collection: what it is."""
MARKER_SIZE_KEY = "scanback_marker_size"
"""Custom property of a reconstruction's collection: how large cameras are drawn in it, in the scene's units."""
MESH_PART, PATH_PART, MARKER_PART, VIEW_PART, REPLAY_PART, LIVE_PART = (
    "mesh", "path", "marker", "view", "replay", "live"
)  # fmt: skip


def marker_size(collection: bpy.types.Collection) -> float:
    """Return how large cameras are drawn in a reconstruction's collection, in the scene's units."""
    return float(collection.get(MARKER_SIZE_KEY, 0.1))


def is_ours(block: bpy.types.ID) -> bool:
    """Tell whether an object or a collection is one that we put into the scene."""
    return PART_KEY in block or FOLDER_KEY in block


def empty_collection(scene: bpy.types.Scene, folder: Path) -> bpy.types.Collection:
    """Return the collection of the reconstruction ``folder`` in ``scene``, new or emptied of what we put there.

    An existing one keeps its place, its name and what the user added to it.
    """
    collection = find_collection(scene, folder)
    if collection is None:
        name = os.fsencode(folder.name).decode("utf-8", "replace")
        collection = bpy.data.collections.new(f"Scanback {name}")
        collection[FOLDER_KEY] = str(folder)
    if collection != scene.collection and collection not in scene.collection.children_recursive:
        scene.collection.children.link(collection)
    remove_parts(collection)
    return collection


def find_collection(scene: bpy.types.Scene, folder: Path) -> bpy.types.Collection | None:
    """Return the collection of the reconstruction ``folder`` that ``scene`` or nothing uses, None without one."""
    in_scene = scene.collection.children_recursive
    for collection in bpy.data.collections:
        is_free = collection in in_scene or collection.users == 0
        if is_free and _is_editable(collection) and folder_of(collection) == folder:
            return collection
    return None


def add_part(
    collection: bpy.types.Collection, part: str, objects: Iterable[bpy.types.Object], *, into: str | None = None
) -> None:
    """Put ``objects`` into ``collection``, or into its sub-collection ``into``, marked as ours."""
    target = collection
    there = [child for child in collection.children if child.get(PART_KEY) == part]
    if into is not None and there:
        target = there[0]
    elif into is not None:
        target = bpy.data.collections.new(into)
        target[PART_KEY] = part
        collection.children.link(target)
    for item in objects:
        item[PART_KEY] = part
        target.objects.link(item)


def parts(collection: bpy.types.Collection, part: str) -> list[bpy.types.Object]:
    """Return the objects of one kind that we put into ``collection``."""
    return [item for item in collection.all_objects if item.get(PART_KEY) == part]


def our_collections(scene: bpy.types.Scene) -> list[bpy.types.Collection]:
    """Return the collections of reconstructions in ``scene``, but for those that belong to another file."""
    ours = (collection for collection in scene.collection.children_recursive if FOLDER_KEY in collection)
    return [collection for collection in ours if _is_editable(collection)]


def folder_of(collection: bpy.types.Collection) -> Path | None:
    """Return the folder of the reconstruction that ``collection`` shows, None where it shows none."""
    folder = collection.get(FOLDER_KEY)
    return Path(bpy.path.abspath(folder)).resolve() if isinstance(folder, str) else None


def remove_parts(collection: bpy.types.Collection, *, part: str | None = None) -> None:
    """Remove our objects of one kind, or all, with their sub-collections and the data that nothing uses after that."""
    ours = [item for item in collection.all_objects if part in (None, item.get(PART_KEY)) and PART_KEY in item]
    data = {item.data for item in ours if item.data is not None}
    actions = {item.animation_data.action for item in ours if item.animation_data is not None} - {None}
    images = {picture.image for item in ours if item.type == "CAMERA" for picture in item.data.background_images}
    materials = {slot.material for item in ours for slot in item.material_slots if slot.material is not None}
    materials |= {material for item in ours for material in materials_of_tubes(item)}
    tubes = {group for item in ours for group in tubes_of(item)}
    bpy.data.batch_remove(ours)
    for unused in (data, materials, tubes, actions, images - {None}):  # in this order: the data uses the others
        bpy.data.batch_remove([block for block in unused if block.users == 0])
    for child in [child for child in collection.children_recursive if _is(child, part)]:
        for item in child.objects:  # what the user put there stays
            if item.name not in collection.objects:
                collection.objects.link(item)
        bpy.data.collections.remove(child)


def _is_editable(collection: bpy.types.Collection) -> bool:
    """Tell whether a collection is this file's own: neither linked from another one nor an override of such."""
    return collection.library is None and collection.override_library is None


def _is(collection: bpy.types.Collection, part: str | None) -> bool:
    return PART_KEY in collection and part in (None, collection[PART_KEY])
