"""The reconstructions that a report is made of, each made once and kept, so that an interrupted report goes on."""

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import warp as wp

from datagen.atomic_write import write_json
from datagen.dataset import Dataset
from datagen.errors import InputError
from fusion.devices import Device
from fusion.evaluation.evaluate import SurfaceSamples, evaluate
from fusion.meshing import asks_depth, depth_oracle, fused_frames
from fusion.reconstruct import reconstruct
from fusion.reconstruction_config import ReconstructionConfig
from fusion.reconstruction_files import (
    MESH_FILE,
    RECORD_FILE,
    VOLUME_FILE,
    ReconstructionRecord,
    installed_versions,
    read_record,
    relative_to,
    write_record,
)
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_files import read_mesh, write_mesh
from fusion.surface.meshers import mesh_volume
from fusion.volume.volume_file import load_volume

VARIANT_FILE = "meshing.json"
TIMED_FOR = 0.5
"""Seconds of processor time for which meshing is repeated, to find the least that it takes."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """A reconstruction: its mesh, its record, and the folder where they lie."""

    mesh: Mesh
    record: ReconstructionRecord
    folder: Path


@dataclass(frozen=True, kw_only=True)
class MeshedRun:
    """A fused volume meshed in some way: the run, and the seconds that meshing takes, of all cores together."""

    run: Run
    seconds: float


def run(dataset: Dataset, folder: Path, config: ReconstructionConfig, *, keep_volume: bool = False) -> Run:
    """Reconstruct into ``folder``, or read what lies there from the same dataset, configuration and versions."""
    kept = (folder / VOLUME_FILE).is_file() or not keep_volume
    if not (kept and _is_current(dataset, folder, config)):
        reconstruct(dataset, folder, config)
    if not keep_volume:
        drop_volume(folder)
    return _read(folder)


def drop_volume(folder: Path) -> None:
    """Remove a run's volume, which is large, and which only meshing in other ways looks at again."""
    (folder / VOLUME_FILE).unlink(missing_ok=True)


def meshed(dataset: Dataset, folder: Path, config: ReconstructionConfig) -> MeshedRun | None:
    """Return what ``mesh_run`` left in ``folder``; None where it is not of this dataset, configuration and versions."""
    if not _is_current(dataset, folder, config) or not (folder / VARIANT_FILE).is_file():
        return None
    return MeshedRun(run=_read(folder), seconds=json.loads((folder / VARIANT_FILE).read_text())["seconds"])


def mesh_run(
    fused: Run, folder: Path, config: ReconstructionConfig, *, truth: tuple[Mesh, SurfaceSamples], device: Device
) -> MeshedRun:
    """Mesh a run's volume as ``config`` says, time it, hold it against the truth and what was seen of it, and keep it.

    On the CPU the time is the least processor time of some repeats, which other programs disturb less; the depth images
    are decoded before.
    """
    volume = load_volume(fused.folder / VOLUME_FILE, device=device)
    oracle = None
    if asks_depth(config):
        with fused_frames(fused.folder, fused.record, config, device) as source:
            oracle = depth_oracle(volume, source, config.integration)
    mesh, seconds = _least_time(
        lambda: mesh_volume(volume, config.mesher, oracle=oracle, min_weight=config.min_weight), device
    )
    thresholds = [entry["threshold_m"] for entry in (fused.record.metrics or {})["fscores"]]
    metrics = evaluate(
        mesh, truth[0], thresholds=thresholds, device=device, seen=truth[1], voxel_size=fused.record.voxel_size_m
    )
    changed = {
        "dataset": relative_to(folder, fused.folder / fused.record.dataset),
        "config": asdict(config),
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.triangles),
        "metrics": metrics,
    }
    write_mesh(folder / MESH_FILE, mesh)
    write_json(folder / VARIANT_FILE, {"seconds": seconds})
    write_record(folder, fused.record.model_copy(update=changed))
    return MeshedRun(run=_read(folder), seconds=seconds)


def _least_time(way: Callable[[], Mesh], device: Device) -> tuple[Mesh, float]:
    """Return what ``way`` returns and the least time that it took, repeated for a while after a first call."""
    clock = time.perf_counter if device.is_cuda else time.process_time
    mesh, least, begin = way(), math.inf, clock()
    while least == math.inf or clock() - begin < TIMED_FOR:
        start = clock()
        mesh = way()
        wp.synchronize_device(device)
        least = min(least, clock() - start)
    return mesh, least


def _read(folder: Path) -> Run:
    return Run(mesh=read_mesh(folder / MESH_FILE), record=read_record(folder), folder=folder)


def _is_current(dataset: Dataset, folder: Path, config: ReconstructionConfig) -> bool:
    if not (folder / RECORD_FILE).is_file() or not (folder / MESH_FILE).is_file():
        return False
    try:
        record = read_record(folder)
    except InputError:  # of an older version, or damaged: it is made anew
        return False
    same_frames = {frame.frame for frame in record.trajectory} <= set(dataset.frame_ids)
    return (
        same_frames
        and record.dataset == relative_to(folder, dataset.folder)
        and record.config == asdict(config)
        and record.versions == installed_versions()
    )
