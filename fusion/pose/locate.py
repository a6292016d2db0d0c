"""Locating the frames of a dataset in a reconstruction on disk."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.atomic_write import write_json
from datagen.dataset import DEPTH_PART, POSE_PART, Dataset
from datagen.errors import InputError
from datagen.frame_selection import select_frames
from datagen.open_dataset import open_dataset
from datagen.progress import ProgressReporter, silent
from datagen.rigid import Matrix, inverse, rigid, rotation_angle_deg
from fusion.devices import load_kernels, resolve_device
from fusion.pose.epipolar import ReferenceFrame
from fusion.pose.nearest_pose import NearestPose, find_nearest_pose
from fusion.pose.pose_model import prepare_model
from fusion.pose.query import Query
from fusion.pose.refinement import Refinement
from fusion.pose.stages import StageName, parse_stages, refine
from fusion.pose.verdict import judge
from fusion.pose.view_index import index_views
from fusion.reconstruction_files import (
    POSES_FILE,
    RECORD_FILE,
    VOLUME_FILE,
    LocatedPose,
    ReconstructionRecord,
    RefinedPose,
    StageResult,
    poses_as_json,
    read_record,
)
from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.mesh import Mesh
from fusion.volume.tsdf_volume import Volume
from fusion.volume.volume_file import load_volume

KERNEL_MODULES = (
    "fusion.volume.block_table",
    "fusion.surface.cells",
    "fusion.surface.marching_cubes",
    "fusion.surface.mesh_ray_casting",
    "fusion.surface.vertex_normals",
)


REFERENCES = 3
"""How many of the nearest fused frames the epipolar stage looks for shared features in."""


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
    stages: str = "nearest",
    device: str = "auto",
    progress: ProgressReporter = silent,
) -> Located:
    """Find the nearest fused pose of each query frame and write ``poses.json`` into the reconstruction's folder.

    ``frames`` is START:STOP:STEP over the dataset; without it, all frames are queries, but those that were fused where
    the reconstruction was made from this dataset. ``stages`` are those of ``fusion.pose.stages``, with commas between;
    what follows ``nearest`` refines the pose. A query needs depth alone; where it has a pose too, the error is
    given. Raises InputError for files that cannot be used, and where no query could be located.
    """
    wanted = parse_stages(stages)
    record = read_record(folder)
    queries = _queries(folder, record, dataset, frames)
    dataset.require(queries, (DEPTH_PART,))
    target = resolve_device(device)
    load_kernels(KERNEL_MODULES, device=target, progress=progress)
    candidates = [
        rigid(frame.world_from_camera, source=f"{folder / RECORD_FILE}: trajectory: frame {frame.frame}")
        for frame in record.trajectory
    ]
    volume = load_volume(folder / VOLUME_FILE, device=target)
    surface = marching_cubes(volume, normals=True)
    refiner = _Refiner(folder, record, volume, surface, wanted) if len(wanted) > 1 else None
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
                    nearest_frames=[record.trajectory[i].frame for i in nearest.indices],
                    ambiguous=nearest.ambiguous,
                    refined=None if refiner is None else refiner(dataset, query, depth, nearest),
                    **_errors(pose, dataset, query),
                )
            )
        advance()
    if not poses:
        raise InputError(f"{dataset.folder}: no frame could be located; frame {queries[0]}: {failures[queries[0]]}")
    write_json(folder / POSES_FILE, poses_as_json(poses))
    return Located(poses=poses, failures=failures)


class _Refiner:
    """The model of a reconstruction, made ready once, and the frames that it was fused from."""

    def __init__(
        self, folder: Path, record: ReconstructionRecord, volume: Volume, surface: Mesh, stages: tuple[StageName, ...]
    ) -> None:
        self._stages = stages
        self._record = record
        self._model = prepare_model(volume, mesh=surface)
        self._fused = open_dataset(folder / record.dataset) if "epipolar" in stages else None

    def __call__(self, dataset: Dataset, frame: int, depth: NDArray[np.float32], nearest: NearestPose) -> RefinedPose:
        """Refine the pose of a frame from the nearest pose's estimate."""
        color = dataset.color(frame) if "epipolar" in self._stages else None
        query = Query(camera=dataset.camera, depth=depth, color=color)
        results = refine(self._model, query, self._references(nearest), nearest.estimate, self._stages)
        verdict = judge(results[-1])
        return RefinedPose(
            world_from_camera=results[-1].world_from_camera.tolist(),
            # Where two alignments are about as good, refinement of one of them cannot tell which is right.
            verdict="doubtful" if verdict.answer == "found" and nearest.ambiguous else verdict.answer,
            reasons=[*verdict.reasons, *(["the view looks alike from another side"] if nearest.ambiguous else [])],
            stages=[_stage_result(result) for result in results],
            **_errors(results[-1].world_from_camera, dataset, frame),
        )

    def _references(self, nearest: NearestPose) -> list[ReferenceFrame]:
        if self._fused is None:
            return []
        frames = [self._record.trajectory[i].frame for i in nearest.indices[:REFERENCES]]
        return [
            ReferenceFrame(
                camera=self._fused.camera,
                color=self._fused.color(i),
                depth=self._fused.depth(i),
                world_from_camera=self._fused.world_from_camera(i),
            )
            for i in frames
        ]


def _stage_result(result: Refinement) -> StageResult:
    return StageResult(
        stage=result.stage,
        converged=result.converged,
        declined=result.declined,
        reason=result.reason,
        residual=result.residual if np.isfinite(result.residual) else None,
        unit=result.unit,
        inlier_share=float(result.inlier_share),
        overlap=result.overlap,
        score=result.score,
    )


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
