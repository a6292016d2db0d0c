"""The whole of a reconstruction folder, put into a scene."""

from pathlib import Path

import bpy

from ..files.reconstruction_files import Reconstruction, read_reconstruction
from .camera_conversion import set_render_size
from .camera_path import create_path_object
from .mesh_import import create_mesh_object
from .pose_markers import create_markers
from .scene_collection import MARKER_PART, MESH_PART, PATH_PART, add_part, empty_collection

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
    reconstruction = read_reconstruction(folder)
    collection = empty_collection(scene, reconstruction.folder)
    _add_parts(collection, reconstruction)
    if match_render_size:
        set_render_size(scene.render, reconstruction.intrinsics)
    return collection


def _add_parts(collection: bpy.types.Collection, reconstruction: Reconstruction) -> None:
    diagonal_m = reconstruction.diagonal_m()
    radius_m = WIRE_RADIUS * diagonal_m
    add_part(collection, MESH_PART, [create_mesh_object("Scanback mesh", reconstruction.mesh)])
    if reconstruction.trajectory:
        path = create_path_object("Scanback camera path", reconstruction.trajectory, radius_m=radius_m)
        add_part(collection, PATH_PART, [path])
    markers = create_markers(
        reconstruction.located, reconstruction.intrinsics, size_m=MARKER_SIZE * diagonal_m, radius_m=radius_m
    )
    if markers:
        add_part(collection, MARKER_PART, markers, into=LOCATED_COLLECTION)
