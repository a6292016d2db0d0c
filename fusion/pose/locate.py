"""Locating the frames of a dataset in a reconstruction on disk."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datagen.atomic_write import write_json
from datagen.dataset import DEPTH_PART, POSE_PART, Dataset
from datagen.errors import InputError
from datagen.frame_selection import select_frames
from datagen.progress import ProgressReporter, silent
from datagen.rigid import Matrix, inverse, rigid, rotation_angle_deg
from fusion.devices import load_kernels, resolve_device
from fusion.pose.nearest_pose import find_nearest_pose
from fusion.pose.view_index import index_views
from fusion.reconstruction_files import (
    POSES_FILE,
    RECORD_FILE,
    VOLUME_FILE,
    LocatedPose,
    ReconstructionRecord,
    poses_as_json,
    read_record,
)
from fusion.surface.marching_cubes import marching_cubes
from fusion.volume.volume_file import load_volume

KERNEL_MODULES = (
    "fusion.volume.block_table",
    "fusion.surface.cells",
    "fusion.surface.marching_cubes",
    "fusion.surface.mesh_ray_casting",
)


@dataclass(frozen=True, kw_only=True)
class Located:
    """The poses that were found, and why the others were not: {frame: reason}."""

    poses: list[LocatedPose]
    failures: dict[int, str]


def locate(
    folder: Path,
    dataset: Dataset,
    *,
    frames: str | None = None,
    device: str = "auto",
    progress: ProgressReporter = silent,
) -> Located:
    """Find the nearest fused pose of each query frame and write ``poses.json`` into the reconstruction's folder.

    ``frames`` is START:STOP:STEP over the dataset; without it, all frames are queries, but those that were fused where
    the reconstruction was made from this dataset. A query needs depth alone; where it has a pose too, the error is
    given. Raises InputError for files that cannot be used, and where no query could be located.
    """
    record = read_record(folder)
    queries = _queries(folder, record, dataset, frames)
    dataset.require(queries, (DEPTH_PART,))
    target = resolve_device(device)
    load_kernels(KERNEL_MODULES, device=target, progress=progress)
    candidates = [
        rigid(frame.world_from_camera, source=f"{folder / RECORD_FILE}: trajectory: frame {frame.frame}")
        for frame in record.trajectory
    ]
    surface = marching_cubes(load_volume(folder / VOLUME_FILE, device=target))
    views = index_views(surface, candidates, dataset.camera, device=target)
    poses: list[LocatedPose] = []
    failures: dict[int, str] = {}
    advance = progress("locate", len(queries))
    for query in queries:
        depth = dataset.depth(query)
        depth[depth > (record.depth_max_m or np.inf)] = 0
        try:
            nearest = find_nearest_pose(views, depth)
        except InputError as error:
            failures[query] = str(error)
        else:
            pose = candidates[nearest.index]
            poses.append(
                LocatedPose(
                    query=query,
                    nearest=record.trajectory[nearest.index].frame,
                    score=float(nearest.scores[0]),
                    world_from_camera=pose.tolist(),
                    **_errors(pose, dataset, query),
                )
            )
        advance()
    if not poses:
        raise InputError(f"{dataset.folder}: no frame could be located; frame {queries[0]}: {failures[queries[0]]}")
    write_json(folder / POSES_FILE, poses_as_json(poses))
    return Located(poses=poses, failures=failures)


def _errors(estimate: Matrix, dataset: Dataset, query: int) -> dict[str, float]:
    """Return the estimate's errors by their names in ``poses.json``, none where the query's pose is not known."""
    if not dataset.has(query, POSE_PART):
        return {}
    rotation_error_deg, translation_error_m = pose_error(estimate, dataset.world_from_camera(query))
    return {"rotation_error_deg": rotation_error_deg, "translation_error_m": translation_error_m}


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
