"""Which of a scene's reconstructions is meant."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import bpy

from ..errors import ReconstructionError
from ..files.dataset_files import METADATA_FILE, read_posed_frames
from ..files.reconstruction_files import POSES_FILE, RECONSTRUCTION_FILE, Record, read_record
from ..results.import_dataset import record_of_frames
from ..results.scene_collection import find_collection, folder_of, our_collections
from ..results.scene_units import record_in_units, unit_of
from ..scan_folder import RECONSTRUCTION, scan_folder


def find_shown(context: Any) -> bpy.types.Collection | None:
    """Return the reconstruction of the active object, of the panel's folder, or the only one; None without any."""
    collections = our_collections(context.scene)
    active = context.view_layer.objects.active
    if active is not None:
        for collection in collections:
            if active.name in collection.all_objects:
                return collection
    named = find_collection(context.scene, scan_folder(context.scene) / RECONSTRUCTION)
    if named in collections:
        return named
    return collections[0] if collections else None


def shown_collection(context: Any) -> bpy.types.Collection:
    """Return the reconstruction that is meant; raises ReconstructionError where the scene has none."""
    found = find_shown(context)
    if found is None:
        raise ReconstructionError("The scene has no reconstruction; fuse one, or import it")
    return found


def record_of(collection: bpy.types.Collection) -> Record:
    """Return what a collection's folder says, in the collection's units, read again only where it has changed."""
    folder = folder_of(collection)
    if folder is None:
        raise ReconstructionError(f"{collection.name} does not say where its reconstruction is; import it again")
    written_ns = (_written_ns(folder / name) for name in (RECONSTRUCTION_FILE, POSES_FILE, METADATA_FILE))
    return _read(folder, unit_of(collection), *written_ns)


@lru_cache(maxsize=8)
def _read(folder: Path, unit: float, *written_ns: int) -> Record:  # noqa: ARG001 - a changed file is another one
    if (folder / METADATA_FILE).is_file() and not (folder / RECONSTRUCTION_FILE).is_file():
        return record_in_units(record_of_frames(read_posed_frames(folder)), unit)
    return record_in_units(read_record(folder), unit)


def _written_ns(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0
