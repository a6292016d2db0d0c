"""The reconstructions that a report is made of, each made once and kept, so that an interrupted report goes on."""

import json
import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import warp as wp

from datagen.atomic_write import write_json
from datagen.dataset import Dataset
from datagen.errors import InputError
from datagen.frame_selection import select_frames
from fusion.devices import Device, load_kernels
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
from fusion.surface.dual_contouring.depth_oracle import DepthField
from fusion.surface.dual_contouring.dual_contouring import oracle_kernels
from fusion.surface.dual_contouring.oracle import Oracle
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_files import read_mesh, write_mesh
from fusion.surface.meshers import kernel_modules, mesh_volume
from fusion.volume.memory_budget import bytes_per_block
from fusion.volume.tsdf_volume import Volume
from fusion.volume.volume_file import load_volume

TIMING_FILE = "timing.json"
TIMED_FOR = 0.5
"""Seconds for which meshing is repeated, to find the least that it takes."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """A reconstruction: its mesh, its record, and the folder where they lie.

    ``mesh_seconds`` is the time that meshing takes, on the CPU that of all cores together; ``load`` how many programs
    wanted a core in the minute before the run ended, None where the system does not tell.
    """

    mesh: Mesh
    record: ReconstructionRecord
    folder: Path
    mesh_seconds: float
    load: float | None

    @property
    def volume_bytes(self) -> int:
        """How much memory the volume's blocks take."""
        return self.record.blocks * bytes_per_block(self.record.config["storage"])


def run(dataset: Dataset, folder: Path, config: ReconstructionConfig, *, keep_volume: bool = False) -> Run:
    """Reconstruct into ``folder``, or read what lies there from the same frames, configuration and versions.

    Meshing is timed once more, as a single time tells little; ``config`` names a mesher that asks the volume alone.
    """
    assert not asks_depth(config), "the depth images are asked by mesh_run"
    kept = (folder / VOLUME_FILE).is_file() or not keep_volume
    current = is_current(dataset, folder, config)
    if not (kept and current):
        # Made again for its volume alone, it keeps the time that another figure tells of it.
        seconds = _read(folder).mesh_seconds if current else None
        (folder / TIMING_FILE).unlink(missing_ok=True)
        volume = reconstruct(dataset, folder, config).volume
        if seconds is None:
            _, seconds = _least_time(
                lambda: mesh_volume(volume, config.mesher, min_weight=config.min_weight), volume.device
            )
        _write_timing(folder, seconds)
    if not keep_volume:
        drop_volume(folder)
    return _read(folder)


def drop_volume(folder: Path) -> None:
    """Remove a run's volume, which is large, and which only meshing in other ways looks at again."""
    (folder / VOLUME_FILE).unlink(missing_ok=True)


def meshed(dataset: Dataset, folder: Path, config: ReconstructionConfig) -> Run | None:
    """Return what ``mesh_run`` left in ``folder``; None where it is not of these frames, configuration and versions."""
    return _read(folder) if is_current(dataset, folder, config) else None


def mesh_run(
    fused: Run,
    folder: Path,
    config: ReconstructionConfig,
    *,
    truth: Mesh,
    seen: SurfaceSamples,
    thresholds: Sequence[float],
    device: Device,
) -> Run:
    """Mesh a run's volume as ``config`` says, time it, hold it against what was ``seen`` of the truth, and keep it.

    On the CPU the time is the least processor time of some repeats, which other programs disturb less. That of
    preparing the depth images where they are asked is in it, that of decoding them is not.
    """
    (folder / TIMING_FILE).unlink(missing_ok=True)
    volume = load_volume(fused.folder / VOLUME_FILE, device=device)
    load_kernels(kernel_modules(config.mesher, flatness=config.flatness), device=device)
    oracle, preparing = _oracle(volume, fused, config) if asks_depth(config) else (None, 0.0)
    mesh, seconds = _least_time(
        lambda: mesh_volume(
            volume, config.mesher, oracle=oracle, min_weight=config.min_weight, flatness=config.flatness
        ),
        device,
    )
    voxel_size = fused.record.voxel_size_m
    changed = {
        "dataset": relative_to(folder, fused.folder / fused.record.dataset),
        "config": asdict(config),
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.triangles),
        "metrics": evaluate(mesh, truth, thresholds=thresholds, device=device, seen=seen, voxel_size=voxel_size),
    }
    write_mesh(folder / MESH_FILE, mesh)
    write_record(folder, fused.record.model_copy(update=changed))
    _write_timing(folder, preparing + seconds)
    return _read(folder)


def _oracle(volume: Volume, fused: Run, config: ReconstructionConfig) -> tuple[Oracle, float]:
    """Return the oracle of the depth images, and the seconds that it took beyond decoding them."""
    device = volume.device
    load_kernels((DepthField.__module__,), device=device)
    clock = _clock(device)
    with fused_frames(fused.folder, fused.record, config) as source:
        start = clock()
        oracle = depth_oracle(volume, source, config.integration)
        wp.synchronize_device(device)
        seconds = clock() - start
        # Threads decode while the caller works: on the wall's clock only the waiting for them is theirs.
        seconds -= source.waiting_seconds if device.is_cuda else source.decoding_seconds
    load_kernels((), oracle_kernels(oracle), device=device)
    return oracle, max(seconds, 0.0)


def _least_time(way: Callable[[], Mesh], device: Device) -> tuple[Mesh, float]:
    """Return what ``way`` returns and the least time that it took, repeated for a while."""
    clock = _clock(device)
    least, begin = math.inf, clock()
    while True:
        start = clock()
        mesh = way()
        wp.synchronize_device(device)
        least = min(least, clock() - start)
        if clock() - begin >= TIMED_FOR:
            return mesh, least


def _clock(device: Device) -> Callable[[], float]:
    return time.perf_counter if device.is_cuda else time.process_time


def _write_timing(folder: Path, mesh_seconds: float) -> None:
    """Write the last of a run's files: a run without it is made again."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    write_json(folder / TIMING_FILE, {"mesh_seconds": mesh_seconds, "load": load})


def _read(folder: Path) -> Run:
    timing = json.loads((folder / TIMING_FILE).read_text())
    return Run(
        mesh=read_mesh(folder / MESH_FILE),
        record=read_record(folder),
        folder=folder,
        mesh_seconds=timing["mesh_seconds"],
        load=timing["load"],
    )


def is_current(dataset: Dataset, folder: Path, config: ReconstructionConfig) -> bool:
    """Tell whether a run is whole, and made from these very frames with this configuration and these versions."""
    if not all((folder / name).is_file() for name in (RECORD_FILE, MESH_FILE, TIMING_FILE)):
        return False
    try:
        record = read_record(folder)
    except InputError:  # of an older version, or damaged: it is made anew
        return False
    return (
        record.dataset == relative_to(folder, dataset.folder)
        and record.config == asdict(config)
        and record.versions == installed_versions()
        and record.camera.camera == dataset.camera
        and _same_frames(dataset, record, config)
        and _newest(dataset, record) <= (folder / TIMING_FILE).stat().st_mtime
    )


def _same_frames(dataset: Dataset, record: ReconstructionRecord, config: ReconstructionConfig) -> bool:
    """Tell whether the frames that would be fused now are those that were: a dataset may have grown since."""
    fused = {frame.frame: frame.world_from_camera for frame in record.trajectory}
    return tuple(fused) == select_frames(dataset.frame_ids, config.frames) and all(
        np.array_equal(dataset.world_from_camera(frame), pose) for frame, pose in fused.items()
    )


def _newest(dataset: Dataset, record: ReconstructionRecord) -> float:
    """Return when the last of the fused images and the true mesh was written: a run that is older is stale."""
    files = [file(frame.frame) for frame in record.trajectory for file in (dataset.color_file, dataset.depth_file)]
    files += [dataset.ground_truth_mesh] if dataset.ground_truth_mesh is not None else []
    return max(path.stat().st_mtime for path in files)
