"""Reconstructions from others on disk: a part of one, or several as one."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from datagen.atomic_write import require_writable
from datagen.errors import InputError
from datagen.progress import ProgressReporter, silent
from fusion.devices import load_kernels, resolve_device
from fusion.meshing import mesh_again, recorded_config
from fusion.reconstruction_config import ReconstructionConfig
from fusion.reconstruction_files import (
    MESH_FILE,
    POSES_FILE,
    RECORD_FILE,
    VOLUME_FILE,
    ReconstructionRecord,
    Seconds,
    installed_versions,
    peak_memory_mb,
    read_record,
    relative_to,
    write_record,
)
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_files import write_mesh
from fusion.surface.meshers import Mesher, OracleName
from fusion.volume.tsdf_volume import Volume
from fusion.volume.volume_file import load_volume, save_volume
from fusion.volume.volume_operations import crop, merge
from fusion.volume.voxel_counts import count_observed

KERNEL_MODULES = (
    "fusion.volume.block_table",
    "fusion.volume.volume_operations",
    "fusion.volume.voxel_counts",
)


def crop_reconstruction(
    folder: Path,
    out: Path,
    *,
    low: ArrayLike,
    high: ArrayLike,
    mesher: Mesher | None = None,
    oracle: OracleName | None = None,
    flatness: float | None = None,
    device: str = "auto",
    progress: ProgressReporter = silent,
) -> ReconstructionRecord:
    """Write the part of a reconstruction in a box of the world (``volume_operations.crop``) as one of its own.

    It is meshed as the whole was, or by ``mesher``, ``oracle`` and ``flatness``. Its record has the frames and times of
    the whole. Raises InputError where the box is none or holds no surface.
    """
    record = read_record(folder)
    config = recorded_config(folder, record, mesher=mesher, oracle=oracle, flatness=flatness)
    _require_new(out, [folder])
    target = resolve_device(device)
    load_kernels(KERNEL_MODULES, device=target, progress=progress)
    volume = crop(load_volume(folder / VOLUME_FILE, device=target), low, high)
    found = f"--low {_listed(low)} --high {_listed(high)}: the volume has blocks in this box"
    mesh = _mesh(volume, folder, record, config, found, progress)
    bounds = (np.maximum(record.bounds_m[0], low).tolist(), np.minimum(record.bounds_m[1], high).tolist())
    changed = {
        "dataset": relative_to(out, folder / record.dataset),
        "bounds_m": bounds,
        "metrics": None,
        "config": record.config | _meshed_by(config) | {"crop": {"low": _listed(low), "high": _listed(high)}},
    }
    return _write(out, volume, mesh, record.model_copy(update=changed | _sizes(volume, mesh)))


def merge_reconstructions(
    folders: Sequence[Path],
    out: Path,
    *,
    mesher: Mesher | None = None,
    oracle: OracleName | None = None,
    flatness: float | None = None,
    device: str = "auto",
    progress: ProgressReporter = silent,
) -> ReconstructionRecord:
    """Write reconstructions of different frames of one dataset as one (``fusion.volume.volume_operations.merge``).

    It is meshed as they were, or by ``mesher``, ``oracle`` and ``flatness``. Times and frames in its record are those
    of all. Raises InputError for reconstructions of different datasets, cameras or voxels, for a frame that is in two
    of them, which would count twice, and where they were meshed differently and it is not said how.
    """
    records = [read_record(folder) for folder in folders]
    _require_disjoint(folders, records)
    config = _common_meshing(folders, records, mesher, oracle, flatness)
    _require_new(out, folders)
    record = _joined(folders, records, out, config)
    target = resolve_device(device)
    load_kernels(KERNEL_MODULES, device=target, progress=progress)
    volume = merge([load_volume(folder / VOLUME_FILE, device=target) for folder in folders])
    mesh = _mesh(volume, out, record, config, f"{out}: the merged volume has blocks", progress)
    return _write(out, volume, mesh, record.model_copy(update=_sizes(volume, mesh)))


def _common_meshing(
    folders: Sequence[Path],
    records: Sequence[ReconstructionRecord],
    mesher: Mesher | None,
    oracle: OracleName | None,
    flatness: float | None,
) -> ReconstructionConfig:
    """Return how all were meshed, or are to be; raises InputError where they were meshed differently."""
    configs = [
        recorded_config(folder, record, mesher=mesher, oracle=oracle, flatness=flatness)
        for folder, record in zip(folders, records, strict=True)
    ]
    for folder, config in zip(folders, configs, strict=True):
        for option in ("mesher", "oracle", "flatness") if config.mesher == "dual-contouring" else ("mesher",):
            ours, first = getattr(config, option), getattr(configs[0], option)
            if ours != first:
                raise InputError(
                    f"{folder}: meshed with --{option} {ours}, and {folders[0]} with {first}; say --{option}"
                )
    return configs[0]


def _joined(
    folders: Sequence[Path], records: Sequence[ReconstructionRecord], out: Path, config: ReconstructionConfig
) -> ReconstructionRecord:
    """Return the record of all frames together."""
    lows, highs = zip(*(record.bounds_m for record in records), strict=True)
    seconds = Seconds(**{stage: sum(getattr(r.seconds, stage) for r in records) for stage in Seconds.model_fields})
    fusing = seconds.allocate + seconds.integrate
    frames = sum(record.frames for record in records)
    farthest = max(math.inf if record.depth_max_m is None else record.depth_max_m for record in records)
    changed = {
        "dataset": relative_to(out, folders[0] / records[0].dataset),
        "frames": frames,
        "trajectory": sorted((f for record in records for f in record.trajectory), key=lambda fused: fused.frame),
        "bounds_m": (np.min(lows, axis=0).tolist(), np.max(highs, axis=0).tolist()),
        "voxel_updates": sum(record.voxel_updates for record in records),
        "seconds": seconds,
        "frames_per_second": frames / fusing,
        "frames_per_second_with_decoding": frames / (fusing + seconds.waiting),
        "metrics": None,
        "depth_max_m": farthest if math.isfinite(farthest) else None,
        "config": {"merged": [record.config for record in records]} | _meshed_by(config),
        "versions": installed_versions(),
    }
    return records[0].model_copy(update=changed)


def _require_disjoint(folders: Sequence[Path], records: Sequence[ReconstructionRecord]) -> None:
    """Raise InputError unless these are two or more, of different frames of one dataset, fused alike."""
    if len(records) < 2:
        raise InputError(f"{folders[0]}: nothing to merge it with; name two reconstructions or more")
    datasets = [(folder / record.dataset).resolve() for folder, record in zip(folders, records, strict=True)]
    fused_in: dict[int, Path] = {}
    for folder, record, dataset in zip(folders, records, datasets, strict=True):
        if dataset != datasets[0] or record.camera != records[0].camera:
            raise InputError(
                f"{folder}: of the dataset {dataset}, and {folders[0]} of {datasets[0]}; "
                "only reconstructions of one dataset are merged, since their poses must be in one world frame"
            )
        ours, first = _fused_with(folder, record), _fused_with(folders[0], records[0])
        for option, value in ours.items():
            if value != first[option]:
                raise InputError(
                    f"{folder}: fused with {option} {value}, and {folders[0]} with {first[option]}; "
                    "only what was fused alike adds up"
                )
        if record.voxel_size_m != records[0].voxel_size_m or record.truncation_m != records[0].truncation_m:
            raise InputError(
                f"{folder}: voxels of {record.voxel_size_m:g} m with a truncation of {record.truncation_m:g} m, and "
                f"{folders[0]} {records[0].voxel_size_m:g} and {records[0].truncation_m:g} m; only equal ones fit"
            )
        if ours["weight_cap"] is not None:
            raise InputError(f"{folder}: its weights are capped, so they do not add up; fuse without --weight-cap")
        for frame in record.trajectory:
            if frame.frame in fused_in:
                raise InputError(
                    f"{folder}: frame {frame.frame} is in {fused_in[frame.frame]} too and would count twice; "
                    "reconstruct different frames with --frames, for example 0::2 and 1::2"
                )
            fused_in[frame.frame] = folder


def _fused_with(folder: Path, record: ReconstructionRecord) -> dict[str, Any]:
    """Return which depth a reconstruction's frames had, and how they were weighed; of a merged one its parts'."""
    config = recorded_config(folder, record)
    return {"min_weight": config.min_weight, "depth_layer": config.depth_layer} | asdict(config.integration)


def _meshed_by(config: ReconstructionConfig) -> dict[str, Any]:
    return {"mesher": config.mesher, "oracle": config.oracle, "flatness": config.flatness}


def _require_new(out: Path, folders: Sequence[Path]) -> None:
    """Raise InputError unless ``out`` can be written without touching what is read."""
    if out.resolve() in [folder.resolve() for folder in folders]:
        raise InputError(f"{out}: is read from; name another folder to write to")
    require_writable(out)


def _mesh(
    volume: Volume,
    folder: Path,
    record: ReconstructionRecord,
    config: ReconstructionConfig,
    found: str,
    progress: ProgressReporter,
) -> Mesh:
    mesh = mesh_again(volume, folder, record, config, progress=progress)
    if len(mesh.triangles) == 0:
        raise InputError(f"{found}, but no surface; nothing was written")
    return mesh


def _sizes(volume: Volume, mesh: Mesh) -> dict[str, Any]:
    return {
        "blocks": volume.table.count,
        "voxels_observed": count_observed(volume),
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.triangles),
        "peak_memory_mb": peak_memory_mb(),
    }


def _listed(corner: ArrayLike) -> list[float | None]:
    """Return a corner as JSON has it, null for no bound."""
    return [float(value) if np.isfinite(value) else None for value in np.asarray(corner)]


def _write(out: Path, volume: Volume, mesh: Mesh, record: ReconstructionRecord) -> ReconstructionRecord:
    """Write the files, the record last: what an older reconstruction left here goes first, as it no longer holds."""
    for older in (RECORD_FILE, POSES_FILE):
        (out / older).unlink(missing_ok=True)
    write_mesh(out / MESH_FILE, mesh)
    save_volume(out / VOLUME_FILE, volume)
    write_record(out, record)
    return record
