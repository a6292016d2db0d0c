"""From a dataset to a coloured mesh: the pipeline of the paper's section IV, stage by stage."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from datagen.atomic_write import require_writable
from datagen.dataset import Dataset
from datagen.dataset_format import Intrinsics
from datagen.errors import InputError
from datagen.frame_selection import select_frames
from datagen.progress import ProgressReporter, silent
from fusion.devices import Device, load_kernels, resolve_device
from fusion.evaluation.evaluate import Observers, evaluate
from fusion.frames.frame_batch import MAX_BATCH
from fusion.frames.frame_source import FrameSource
from fusion.frames.survey import SceneSurvey, combine
from fusion.integration.fuse import WATCHED_BATCH, Fused, Watcher, fuse
from fusion.integration.fuse_batch import load_fusion_kernels
from fusion.meshing import mesh_fused
from fusion.reconstruction_config import Lengths, ReconstructionConfig, choose_lengths
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
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_files import read_mesh, write_mesh
from fusion.surface.meshers import kernel_modules
from fusion.volume.tsdf_volume import Volume
from fusion.volume.volume_file import save_volume
from fusion.volume.voxel_counts import count_observed


@dataclass(frozen=True, kw_only=True)
class Reconstruction:
    """What a reconstruction made: the fused volume, its mesh and the record that goes to disk with them."""

    volume: Volume
    mesh: Mesh
    record: ReconstructionRecord


def reconstruct(
    dataset: Dataset,
    folder: Path,
    config: ReconstructionConfig,
    *,
    progress: ProgressReporter = silent,
    watch: Watcher | None = None,
) -> Reconstruction:
    """Fuse a dataset and write the reconstruction into ``folder``, its record last.

    ``watch`` is shown the volume while it grows: frames then come in smaller batches, and packed voxels are rounded
    more often.
    Raises InputError for frames that cannot be used, and for a volume that does not fit into memory before any of it is
    allocated; then nothing is written.
    """
    require_writable(folder)
    ground_truth = None if dataset.ground_truth_mesh is None else read_mesh(dataset.ground_truth_mesh)
    seen = dataset if config.depth_layer is None else dataset.with_depth_layer(config.depth_layer)
    device = resolve_device(config.device)
    load_fusion_kernels(config.integration, device=device, progress=progress)
    modules = ("fusion.volume.voxel_counts", *kernel_modules(config.mesher, flatness=config.flatness))
    load_kernels(modules, device=device, progress=progress)
    start = time.perf_counter()
    clock = Stopwatch(device)
    frame_ids = select_frames(dataset.frame_ids, config.frames)
    batch_size = MAX_BATCH if watch is None else WATCHED_BATCH
    with FrameSource(seen, frame_ids, depth_max=config.depth_max, batch_size=batch_size) as source:
        lengths = choose_lengths(config, lambda: _survey(source, progress))
        fused = fuse(
            source,
            lengths,
            device=device,
            storage=config.storage,
            integration=config.integration,
            clock=clock,
            progress=progress,
            watch=watch,
        )
        clock.seconds["waiting"] = source.waiting_seconds
        mesh = _mesh(fused.volume, source, config, clock, progress)
    clock.seconds["decode"] = source.decoding_seconds
    # Meshing waits for frames of its own.
    clock.seconds["mesh"] += source.waiting_seconds - clock.seconds["waiting"]
    metrics = None
    if ground_truth is not None:
        with clock("evaluate"):
            metrics = _evaluate(mesh, ground_truth, dataset, frame_ids, config, lengths, device, progress)
    with clock("write"):
        _write_arrays(folder, mesh, fused.volume, progress)
    clock.seconds["total"] = time.perf_counter() - start
    record = _record(source, folder, config, fused, mesh, metrics, clock)
    write_record(folder, record)
    return Reconstruction(volume=fused.volume, mesh=mesh, record=record)


def _survey(source: FrameSource, progress: ProgressReporter) -> SceneSurvey:
    """Decode the depth of all frames once, for the scale of what they show."""
    advance = progress("survey", len(source.frame_ids))
    for frames in source.depth_batches():
        for _ in frames.frame_ids:
            advance()
    return combine(list(source.surveys.values()), source.dataset.camera)


def _mesh(
    volume: Volume, source: FrameSource, config: ReconstructionConfig, clock: Stopwatch, progress: ProgressReporter
) -> Mesh:
    mesh = mesh_fused(volume, source, config, clock=clock, progress=progress)
    if len(mesh.triangles) == 0:
        raise InputError(
            f"{source.dataset.folder}: the frames make no surface at a voxel size of {volume.voxel_size:g} m; "
            "try a smaller --voxel-size or --min-weight, and check the depth with datagen info"
        )
    return mesh


def _evaluate(
    mesh: Mesh,
    ground_truth: Mesh,
    dataset: Dataset,
    frame_ids: tuple[int, ...],
    config: ReconstructionConfig,
    lengths: Lengths,
    device: Device,
    progress: ProgressReporter,
) -> dict[str, Any]:
    return evaluate(
        mesh,
        ground_truth,
        thresholds=(lengths.voxel_size / 2, lengths.voxel_size),
        device=device,
        observed_by=Observers(dataset=dataset, frame_ids=frame_ids, depth_max=config.depth_max),
        voxel_size=lengths.voxel_size,
        progress=progress,
    )


def _write_arrays(folder: Path, mesh: Mesh, volume: Volume, progress: ProgressReporter) -> None:
    """Write mesh and volume: what an older reconstruction left here to speak for its own goes first."""
    advance = progress("write", 2)
    for older in (RECORD_FILE, POSES_FILE):
        (folder / older).unlink(missing_ok=True)
    with ThreadPoolExecutor(thread_name_prefix="write") as pool:
        writing = [
            pool.submit(write_mesh, folder / MESH_FILE, mesh),
            pool.submit(save_volume, folder / VOLUME_FILE, volume),
        ]
        for written in writing:
            written.result()
            advance()


def _record(
    source: FrameSource,
    folder: Path,
    config: ReconstructionConfig,
    fused: Fused,
    mesh: Mesh,
    metrics: dict[str, Any] | None,
    clock: Stopwatch,
) -> ReconstructionRecord:
    volume, dataset, frames = fused.volume, source.dataset, len(source.frame_ids)
    seconds = Seconds(**{stage: clock.seconds[stage] for stage in Seconds.model_fields})
    fusing = seconds.allocate + seconds.integrate
    return ReconstructionRecord(
        dataset=relative_to(folder, dataset.folder),
        frames=frames,
        voxel_size_m=volume.voxel_size,
        truncation_m=volume.truncation,
        bounds_m=(fused.survey.low.tolist(), fused.survey.high.tolist()),
        blocks=volume.table.count,
        voxels_observed=count_observed(volume),
        voxel_updates=fused.voxel_updates,
        device=volume.device.name if volume.device.is_cuda else "cpu",
        seconds=seconds,
        frames_per_second=frames / fusing,
        frames_per_second_with_decoding=frames / (fusing + seconds.waiting),
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
