"""The whole of a reconstruction folder, put into a scene."""

from pathlib import Path

import bpy

from ..files.reconstruction_files import Reconstruction, Record, read_reconstruction
from .camera_conversion import set_render_size
from .camera_path import create_path_object
from .mesh_import import create_mesh_object
from .pose_markers import create_markers
from .scene_collection import (
    MARKER_PART,
    MARKER_SIZE_KEY,
    MESH_PART,
    PATH_PART,
    add_part,
    empty_collection,
    find_collection,
    remove_parts,
)
from .scene_units import UNIT_KEY, metres_per_unit, reconstruction_in_units, record_in_units, unit_of

MESH_NAME = "Scanback mesh"
LOCATED_COLLECTION = "Located frames"
MARKER_SIZE = 0.06
WIRE_RADIUS = 0.0016
"""Sizes as parts of the diagonal of mesh and camera path."""


def import_reconstruction(
    scene: bpy.types.Scene, folder: Path, *, match_render_size: bool = True
) -> bpy.types.Collection:
    """Put mesh, camera path and located frames of ``folder`` into a collection of their own and return it.

    What an earlier import of the same folder made is replaced. ``match_render_size`` gives the scene's renders the
    scan's size and pixel aspect, without which the markers' cameras show another crop than the scan's camera did.
    Everything is read and checked before the scene is touched: ReconstructionError leaves it as it was.
    """
    reconstruction = reconstruction_in_units(read_reconstruction(folder), metres_per_unit(scene))
    mesh = create_mesh_object(MESH_NAME, reconstruction.mesh)
    return place_reconstruction(scene, reconstruction, mesh, match_render_size=match_render_size)


def place_reconstruction(
    scene: bpy.types.Scene, reconstruction: Reconstruction, mesh: bpy.types.Object, *, match_render_size: bool = True
) -> bpy.types.Collection:
    """Put a reconstruction in the scene's units, with the object of its mesh, into its collection as above."""
    collection = empty_collection(scene, reconstruction.folder)
    # Names are given when those of what was replaced are free again.
    mesh.name = mesh.data.name = MESH_NAME
    for material in mesh.data.materials:
        material.name = f"{MESH_NAME} colours"
    add_part(collection, MESH_PART, [mesh])
    collection[UNIT_KEY] = reconstruction.metres_per_unit
    diagonal = reconstruction.diagonal()
    collection[MARKER_SIZE_KEY] = MARKER_SIZE * diagonal
    if reconstruction.trajectory:
        path = create_path_object("Scanback camera path", reconstruction.trajectory, radius=WIRE_RADIUS * diagonal)
        add_part(collection, PATH_PART, [path])
    _add_markers(collection, reconstruction)
    if match_render_size:
        set_render_size(scene.render, reconstruction.intrinsics)
    return collection


def place_located(scene: bpy.types.Scene, record: Record) -> bpy.types.Collection | None:
    """Replace the located frames of a reconstruction that is in the scene by the record's; None where it is not."""
    collection = find_collection(scene, record.folder)
    if collection is None or MARKER_SIZE_KEY not in collection:
        return None
    remove_parts(collection, part=MARKER_PART)
    _add_markers(collection, record_in_units(record, unit_of(collection)))
    return collection


def _add_markers(collection: bpy.types.Collection, record: Record) -> None:
    size = float(collection[MARKER_SIZE_KEY])
    markers = create_markers(
        record.located,
        record.intrinsics,
        dataset=record.dataset,
        size=size,
        radius=size * WIRE_RADIUS / MARKER_SIZE,
    )
    if markers:
        add_part(collection, MARKER_PART, markers, into=LOCATED_COLLECTION)
