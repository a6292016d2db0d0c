"""Locating the frames of a dataset in a reconstruction on disk."""

from pathlib import Path

import numpy as np

from datagen.atomic_write import write_json
from datagen.dataset import Dataset
from datagen.errors import InputError
from datagen.frame_selection import select_frames
from datagen.progress import ProgressReporter, silent
from datagen.rigid import Matrix, inverse, rigid, rotation_angle_deg
from fusion.devices import load_kernels, resolve_device
from fusion.marching_cubes import marching_cubes
from fusion.nearest_pose import find_nearest_pose, view_surface
from fusion.reconstruction_files import (
    POSES_FILE,
    RECORD_FILE,
    VOLUME_FILE,
    LocatedPose,
    ReconstructionRecord,
    poses_as_json,
    read_record,
)
from fusion.volume_file import load_volume

KERNEL_MODULES = ("fusion.block_table", "fusion.marching_cubes", "fusion.nearest_pose")


def locate(
    folder: Path,
    dataset: Dataset,
    *,
    frames: str | None = None,
    device: str = "auto",
    progress: ProgressReporter = silent,
) -> list[LocatedPose]:
    """Find the nearest fused pose of each query frame and write ``poses.json`` into the reconstruction's folder.

    ``frames`` is START:STOP:STEP over the dataset; without it, all frames are queries, but those that were fused where
    the reconstruction was made from this dataset. Raises InputError for files and frames that cannot be used.
    """
    record = read_record(folder)
    queries = _queries(folder, record, dataset, frames)
    dataset.require_complete(queries)
    target = resolve_device(device)
    volume = load_volume(folder / VOLUME_FILE, device=target)
    load_kernels(KERNEL_MODULES, device=target, progress=progress)
    candidates = [
        rigid(frame.world_from_camera, source=f"{folder / RECORD_FILE}: trajectory: frame {frame.frame}")
        for frame in record.trajectory
    ]
    depth_max = record.config.get("depth_max") or np.inf
    views = view_surface(marching_cubes(volume), candidates, dataset.camera, device=target)
    located = []
    advance = progress("locate", len(queries))
    for query in queries:
        depth = dataset.depth(query)
        depth[depth > depth_max] = 0
        try:
            nearest = find_nearest_pose(views, depth)
        except InputError as error:
            raise InputError(f"{dataset.folder}: frame {query}: {error}") from error
        pose = candidates[nearest.index]
        rotation_error_deg, translation_error_m = pose_error(pose, dataset.world_from_camera(query))
        located.append(
            LocatedPose(
                query=query,
                nearest=record.trajectory[nearest.index].frame,
                score=float(nearest.scores[nearest.index]),
                world_from_camera=pose.tolist(),
                rotation_error_deg=rotation_error_deg,
                translation_error_m=translation_error_m,
            )
        )
        advance()
    write_json(folder / POSES_FILE, poses_as_json(located))
    return located


def pose_error(estimate: Matrix, truth: Matrix) -> tuple[float, float]:
    """Return the angle (degrees) and the distance (metres) between two world_from_camera poses."""
    distance = float(np.linalg.norm(estimate[:3, 3] - truth[:3, 3]))
    return rotation_angle_deg(inverse(estimate) @ truth), distance


def _queries(folder: Path, record: ReconstructionRecord, dataset: Dataset, frames: str | None) -> tuple[int, ...]:
    if frames is not None or (folder / record.dataset).resolve() != dataset.folder.resolve():
        return select_frames(dataset.frame_ids, frames)
    fused = {frame.frame for frame in record.trajectory}
    held_out = tuple(frame_id for frame_id in dataset.frame_ids if frame_id not in fused)
    if not held_out:
        raise InputError(
            f"{dataset.folder}: all of its frames were fused, none is left to locate; "
            "choose some with --frames, or reconstruct from every second one with --frames ::2"
        )
    return held_out
