"""From a dataset to a coloured mesh: the pipeline of the paper's section IV, stage by stage."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from datagen.dataset import Dataset
from datagen.dataset_format import Intrinsics
from datagen.errors import InputError
from datagen.frame_selection import select_frames
from datagen.progress import ProgressReporter, silent
from fusion.block_table import BlockLimitError
from fusion.devices import Device, load_kernels, resolve_device
from fusion.evaluate import evaluate_reconstruction
from fusion.find_blocks import FoundBlocks, find_blocks
from fusion.frame_batch import FrameBatch, FrameUploader
from fusion.frame_source import FrameSource
from fusion.integrate import integrate_blocks
from fusion.marching_cubes import marching_cubes
from fusion.mesh import Mesh, write_ply
from fusion.reconstruction_config import VOXELS_PER_TRUNCATION, ReconstructionConfig, choose_voxel_size
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
from fusion.survey import SceneSurvey, combine, survey_frame
from fusion.volume import Volume
from fusion.volume_file import save_volume
from fusion.volume_memory import block_budget, is_hopeless, too_large

KERNEL_MODULES = ("fusion.block_table", "fusion.find_blocks", "fusion.integrate", "fusion.marching_cubes")


@dataclass(frozen=True, kw_only=True)
class Reconstruction:
    """What a reconstruction made: the fused volume, its mesh and the record that goes to disk with them."""

    volume: Volume
    mesh: Mesh
    record: ReconstructionRecord


class _Stopwatch:
    """Adds up wall time by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


def reconstruct(
    dataset: Dataset, folder: Path, config: ReconstructionConfig, *, progress: ProgressReporter = silent
) -> Reconstruction:
    """Fuse a dataset and write the reconstruction into ``folder``, its record last.

    Raises InputError for frames that cannot be used, and for a volume that does not fit into memory before any of it is
    allocated; then nothing is written.
    """
    start = time.perf_counter()
    device = resolve_device(config.device)
    load_kernels(KERNEL_MODULES, device=device, progress=progress)
    clock = _Stopwatch()
    frame_ids = select_frames(dataset.frame_ids, config.frames)
    with FrameSource(dataset, frame_ids, depth_max=config.depth_max) as source:
        survey = _survey(source, progress)
        voxel_size = config.voxel_size or choose_voxel_size(survey)
        truncation = config.truncation or VOXELS_PER_TRUNCATION * voxel_size
        if truncation < voxel_size:
            raise InputError(
                f"--truncation {truncation:g}: less than a voxel, which the data suggest to be {voxel_size:g} m; "
                "give a smaller --voxel-size too"
            )
        volume = _fuse(source, survey, voxel_size, truncation, device, clock, progress)
    advance = progress("mesh", 1)
    with clock("mesh"):
        mesh = marching_cubes(volume)
    advance()
    if len(mesh.triangles) == 0:
        raise InputError(
            f"{dataset.folder}: the frames make no surface at a voxel size of {voxel_size:g} m; "
            "try a smaller --voxel-size, and check the depth with datagen info"
        )
    metrics = evaluate_reconstruction(mesh, dataset, frame_ids, voxel_size, device, progress)
    record = ReconstructionRecord(
        dataset=relative_to(folder, dataset.folder),
        frames=len(frame_ids),
        voxel_size_m=voxel_size,
        truncation_m=truncation,
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
            surveys.append(survey_frame(camera, depth, source.poses[frame_id]))
            advance()
    return combine(surveys, camera)


def _fuse(
    source: FrameSource,
    survey: SceneSurvey,
    voxel_size: float,
    truncation: float,
    device: Device,
    clock: _Stopwatch,
    progress: ProgressReporter,
) -> Volume:
    """Find all blocks, allocate them once, and integrate the frames batch by batch."""
    upload = FrameUploader(source.dataset.camera, device=device)

    def depth_batches() -> Iterator[FrameBatch]:
        for frame_ids in source.batches():
            yield upload(source.depths(frame_ids), [source.poses[i] for i in frame_ids])

    lengths: dict[str, Any] = {"voxel_size": voxel_size, "truncation": truncation}
    if is_hopeless(survey, voxel_size=voxel_size, device=device):
        raise too_large(depth_batches, survey, device=device, **lengths)
    volume = Volume(device=device, max_blocks=block_budget(device), **lengths)
    try:
        found = _find_all(volume, depth_batches(), len(source.frame_ids), clock, progress)
    except BlockLimitError:
        raise too_large(depth_batches, survey, device=device, **lengths) from None
    volume.reserve(volume.table.count)
    advance = progress("integrate", len(source.frame_ids))
    for frame_ids, found_blocks in zip(source.batches(), found, strict=True):
        depths, colors = source.depths(frame_ids), source.colors(frame_ids)
        with clock("integrate"):
            batch = upload(depths, [source.poses[i] for i in frame_ids], colors)
            integrate_blocks(volume, batch, found_blocks)
        for _ in frame_ids:
            advance()
    return volume


def _find_all(
    volume: Volume, batches: Iterator[FrameBatch], total: int, clock: _Stopwatch, progress: ProgressReporter
) -> list[FoundBlocks]:
    """Run the allocation pass over all frames; no voxel is allocated yet."""
    advance = progress("allocate", total)
    found = []
    for batch in batches:
        with clock("integrate"):
            found.append(find_blocks(volume.table, batch, truncation=volume.truncation, voxel_size=volume.voxel_size))
        for _ in range(len(batch)):
            advance()
    return found


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
