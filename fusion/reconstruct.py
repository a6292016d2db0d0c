"""From a dataset to a coloured mesh: the pipeline of the paper's section IV, stage by stage."""

import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from datagen.atomic_write import require_writable
from datagen.dataset import Dataset
from datagen.dataset_format import Intrinsics
from datagen.errors import InputError
from datagen.frame_selection import select_frames
from datagen.progress import ProgressReporter, silent
from fusion.devices import load_kernels, resolve_device
from fusion.evaluate import Observers, evaluate
from fusion.frame_source import FrameSource
from fusion.fuse import fuse
from fusion.marching_cubes import marching_cubes
from fusion.mesh import Mesh, read_mesh, write_ply
from fusion.reconstruction_config import ReconstructionConfig, choose_lengths
from fusion.reconstruction_files import (
    MESH_FILE,
    POSES_FILE,
    RECORD_FILE,
    VOLUME_FILE,
    FusedFrame,
    ReconstructionRecord,
    Seconds,
    installed_versions,
    peak_memory_mb,
    relative_to,
    write_record,
)
from fusion.stopwatch import Stopwatch
from fusion.survey import SceneSurvey, combine, survey_frame
from fusion.volume import Volume
from fusion.volume_file import save_volume

KERNEL_MODULES = (
    "fusion.block_table",
    "fusion.find_blocks",
    "fusion.visible_blocks",
    "fusion.cells",
    "fusion.marching_cubes",
)


@dataclass(frozen=True, kw_only=True)
class Reconstruction:
    """What a reconstruction made: the fused volume, its mesh and the record that goes to disk with them."""

    volume: Volume
    mesh: Mesh
    record: ReconstructionRecord


def reconstruct(
    dataset: Dataset, folder: Path, config: ReconstructionConfig, *, progress: ProgressReporter = silent
) -> Reconstruction:
    """Fuse a dataset and write the reconstruction into ``folder``, its record last.

    Raises InputError for frames that cannot be used, and for a volume that does not fit into memory before any of it is
    allocated; then nothing is written.
    """
    require_writable(folder)
    ground_truth = None if dataset.ground_truth_mesh is None else read_mesh(dataset.ground_truth_mesh)
    device = resolve_device(config.device)
    load_kernels(KERNEL_MODULES, device=device, progress=progress)
    start = time.perf_counter()
    clock = Stopwatch(device)
    frame_ids = select_frames(dataset.frame_ids, config.frames)
    with FrameSource(dataset, frame_ids, depth_max=config.depth_max) as source:
        survey = _survey(source, progress)
        lengths = choose_lengths(config, survey)
        volume = fuse(source, survey, lengths, device=device, storage=config.storage, clock=clock, progress=progress)
    mesh = _mesh(volume, dataset, clock, progress)
    metrics = None
    if ground_truth is not None:
        metrics = evaluate(
            mesh,
            ground_truth,
            thresholds=(lengths.voxel_size / 2, lengths.voxel_size),
            device=device,
            observed_by=Observers(dataset=dataset, frame_ids=frame_ids, depth_max=config.depth_max),
            voxel_size=lengths.voxel_size,
            progress=progress,
        )
    record = ReconstructionRecord(
        dataset=relative_to(folder, dataset.folder),
        frames=len(frame_ids),
        voxel_size_m=lengths.voxel_size,
        truncation_m=lengths.truncation,
        bounds_m=(survey.low.tolist(), survey.high.tolist()),
        blocks=volume.table.count,
        device=device.name if device.is_cuda else "cpu",
        seconds=Seconds(decode=source.seconds, total=time.perf_counter() - start, **clock.seconds),
        frames_per_second=len(frame_ids) / clock.seconds["integrate"],
        vertices=len(mesh.vertices),
        triangles=len(mesh.triangles),
        peak_memory_mb=peak_memory_mb(),
        metrics=metrics,
        camera=Intrinsics(**asdict(dataset.camera)),
        trajectory=[FusedFrame(frame=i, world_from_camera=pose.tolist()) for i, pose in source.poses.items()],
        depth_max_m=config.depth_max,
        config=asdict(config),
        versions=installed_versions(),
    )
    result = Reconstruction(volume=volume, mesh=mesh, record=record)
    _write(folder, result, progress)
    return result


def _survey(source: FrameSource, progress: ProgressReporter) -> SceneSurvey:
    """Decode the depth of all frames once, for the volume's bounds."""
    camera = source.dataset.camera
    advance = progress("survey", len(source.frame_ids))
    surveys = []
    for frame_ids in source.batches():
        for frame_id, depth in zip(frame_ids, source.depths(frame_ids), strict=True):
            metres = depth.astype(np.float32) * np.float32(source.dataset.depth_scale)
            surveys.append(survey_frame(camera, metres, source.poses[frame_id]))
            advance()
    return combine(surveys, camera)


def _mesh(volume: Volume, dataset: Dataset, clock: Stopwatch, progress: ProgressReporter) -> Mesh:
    advance = progress("mesh", 1)
    with clock("mesh"):
        mesh = marching_cubes(volume)
    advance()
    if len(mesh.triangles) == 0:
        raise InputError(
            f"{dataset.folder}: the frames make no surface at a voxel size of {volume.voxel_size:g} m; "
            "try a smaller --voxel-size, and check the depth with datagen info"
        )
    return mesh


def _write(folder: Path, result: Reconstruction, progress: ProgressReporter) -> None:
    """Write the files, the record last: what an older reconstruction left here goes first, as it no longer holds."""
    advance = progress("write", 3)
    for older in (RECORD_FILE, POSES_FILE):
        (folder / older).unlink(missing_ok=True)
    write_ply(folder / MESH_FILE, result.mesh)
    advance()
    save_volume(folder / VOLUME_FILE, result.volume)
    advance()
    write_record(folder, result.record)
    advance()
