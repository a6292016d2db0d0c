"""A dataset in the scene, without any fusion: its camera's path and a camera that goes it again, with its pictures."""

from pathlib import Path

import bpy
import numpy as np

from ..files.dataset_files import PosedFrames, read_posed_frames
from ..files.reconstruction_files import Record
from .camera_conversion import set_render_size
from .camera_path import create_path_object
from .import_reconstruction import MARKER_SIZE, WIRE_RADIUS
from .replay_camera import add_replay
from .scene_collection import MARKER_SIZE_KEY, PATH_PART, add_part, empty_collection
from .scene_units import UNIT_KEY, frames_in_units, metres_per_unit, record_in_units


def import_dataset(
    scene: bpy.types.Scene, folder: Path, *, match_render_size: bool = True
) -> tuple[bpy.types.Collection, PosedFrames]:
    """Put the path and the camera of the dataset ``folder`` into a collection of their own; again replaces.

    Everything is read before the scene is touched: ReconstructionError leaves it as it was.
    """
    frames = read_posed_frames(folder)
    unit = metres_per_unit(scene)
    trajectory = frames_in_units(frames.trajectory, unit)
    collection = empty_collection(scene, frames.folder)
    collection[UNIT_KEY] = unit
    positions = np.array([frame.world_from_camera[:3, 3] for frame in trajectory])
    diagonal = float(np.linalg.norm(np.ptp(positions, axis=0))) or 1.0
    collection[MARKER_SIZE_KEY] = MARKER_SIZE * diagonal
    path = create_path_object("Scanback camera path", trajectory, radius=WIRE_RADIUS * diagonal)
    add_part(collection, PATH_PART, [path])
    add_replay(scene, collection, record_in_units(record_of_frames(frames), unit))
    if match_render_size:
        set_render_size(scene.render, frames.intrinsics)
    return collection, frames


def record_of_frames(frames: PosedFrames) -> Record:
    """Return a dataset's frames as what a reconstruction of all of them would tell, without any mesh."""
    return Record(
        folder=frames.folder,
        dataset=frames.folder,
        intrinsics=frames.intrinsics,
        voxel_size_m=None,
        trajectory=frames.trajectory,
        located=(),
    )
