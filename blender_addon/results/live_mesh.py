"""The mesh as it grows: shown while frames are fused, gone when that is over."""

import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import bpy

from ..errors import ReconstructionError
from ..files.mesh_arrays import MeshArrays, mesh_arrays
from ..files.ply_mesh import read_colored_mesh
from .mesh_import import fill_mesh, object_of
from .originals import keep_from_renders, originals_of, set_hidden
from .scene_collection import LIVE_PART, MESH_PART, PART_KEY, find_collection, parts
from .scene_units import mesh_in_units
from .viewport_colors import suit_shading

NAME = "Scanback live"
ASIDE_KEY = "scanback_aside"
"""Custom property of a growing mesh: the objects that viewports and renders are without while it is there."""


class LiveMesh:
    """Shows a mesh file in a scene and follows it as it is written anew.

    An older result of ``folder`` and its originals, which stand in its place, are hidden meanwhile. The file is read in
    a thread; what it holds is small enough to be handed to Blender within a tick. ``unit`` is how many metres a unit of
    the scene is.
    """

    def __init__(
        self,
        file: Path,
        folder: Path,
        find_scene: Callable[[], bpy.types.Scene],
        *,
        unit: float = 1.0,
    ) -> None:
        self._file = file
        self._folder = folder
        self._find_scene = find_scene
        self._unit = unit
        self._seen_ns = 0
        self._reader: threading.Thread | None = None
        self._arrays: MeshArrays | None = None

    def follow(self) -> None:
        """Look at the file, and show it where it is new; to be called at every tick."""
        if self._reader is not None:
            if self._reader.is_alive():
                return
            self._reader = None
            if self._arrays is not None:
                self._show(self._arrays)
        try:
            written_ns = self._file.stat().st_mtime_ns
        except OSError:
            return
        if written_ns != self._seen_ns:
            self._seen_ns = written_ns
            self._reader = threading.Thread(target=self._read, name=NAME, daemon=True)
            self._reader.start()

    def remove(self) -> None:
        """Take it away and let what stood aside be seen again."""
        remove_live_meshes()

    def _read(self) -> None:
        try:
            self._arrays = mesh_arrays(mesh_in_units(read_colored_mesh(self._file), self._unit))
        except ReconstructionError:
            self._arrays = None  # the next one may be whole

    def _show(self, arrays: MeshArrays) -> None:
        try:
            scene = self._find_scene()
        except ReconstructionError:
            return
        item = next((item for item in scene.objects if item.get(PART_KEY) == LIVE_PART), None)
        name = ""
        for name in fill_mesh(NAME, arrays):  # noqa: B007 - the last one counts
            pass
        data = bpy.data.meshes[name]
        if item is None:
            item = object_of(NAME, data)
            item[PART_KEY] = LIVE_PART
            item.hide_select = True
            scene.collection.objects.link(item)
            beside = self._beside(scene)
            hidden, kept = set_hidden(scene, beside, hidden=True), keep_from_renders(scene, beside, kept=True)
            item[ASIDE_KEY] = {"viewports": _pointers(hidden), "renders": _pointers(kept)}
            suit_shading(scene)
            return
        older, item.data = item.data, data
        for material in older.materials:
            data.materials.append(material)
        bpy.data.meshes.remove(older)

    def _beside(self, scene: bpy.types.Scene) -> list[bpy.types.Object]:
        """Return the objects that are where it grows."""
        collection = find_collection(scene, self._folder)
        older = parts(collection, MESH_PART) if collection is not None else []
        return [*older, *originals_of(scene, self._folder)]


def remove_live_meshes() -> None:
    """Take away all growing meshes, also those that an undo or a saved file brought back; show what stood aside."""
    ours = [item for item in bpy.data.objects if item.get(PART_KEY) == LIVE_PART and item.library is None]
    for item in ours:
        hidden, kept = (_pointed_at(item, kind) for kind in ("viewports", "renders"))
        for scene in item.users_scene:
            set_hidden(scene, hidden, hidden=False)
            keep_from_renders(scene, kept, kept=False)
    data = {item.data for item in ours}
    materials = {material for mesh in data for material in mesh.materials if material is not None}
    bpy.data.batch_remove(ours)
    for unused in (data, materials):
        bpy.data.batch_remove([block for block in unused if block.users == 0])


def _pointers(items: Sequence[bpy.types.Object]) -> dict[str, bpy.types.Object]:
    return {str(number): item for number, item in enumerate(items)}


def _pointed_at(item: bpy.types.Object, kind: str) -> list[bpy.types.Object]:
    """Return the objects that stand aside for a growing mesh and are still there."""
    aside = item.get(ASIDE_KEY, {})
    return [other for other in aside.get(kind, {}).values() if other is not None]
