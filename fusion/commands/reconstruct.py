"""``fusion reconstruct``: a dataset into a coloured mesh."""

import argparse
from pathlib import Path
from typing import get_args

from rich.console import Console
from rich.table import Table

from datagen.commands.arguments import add_frames, add_json, positive
from datagen.commands.job_options import add_job_options, reporting
from datagen.open_dataset import open_dataset
from fusion.commands.arguments import (
    add_dataset,
    add_depth_layer,
    add_depth_max,
    add_device,
    add_out_folder,
    add_truncation,
    add_voxel_size,
    print_json,
)
from fusion.commands.metrics import print_metrics
from fusion.integration.options import DepthSampling, Integration, Weighting
from fusion.reconstruct import reconstruct
from fusion.reconstruction_config import ReconstructionConfig, check_meshing
from fusion.reconstruction_files import ReconstructionRecord
from fusion.snapshots import Snapshots
from fusion.surface.meshers import Mesher, OracleName
from fusion.volume.voxels import Storage


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    add_dataset(command)
    add_out_folder(command)
    add_voxel_size(command)
    add_truncation(command)
    add_depth_max(command)
    add_depth_layer(command)
    _add_integration(command)
    _add_meshing(command)
    add_frames(command)
    add_device(command)
    add_json(command)
    command.add_argument(
        "--snapshots", type=Path, metavar="FILE", help="while fusing, write a small mesh of what is there so far (.ply)"
    )
    command.add_argument(
        "--snapshot-count", type=positive, default=20, metavar="N", help="how often (default: %(default)s)"
    )
    add_job_options(command)
    command.set_defaults(run=_run)


def _add_integration(command: argparse.ArgumentParser) -> None:
    defaults = ReconstructionConfig()
    command.add_argument(
        "--depth-sampling",
        choices=get_args(DepthSampling),
        default=defaults.integration.depth_sampling,
        help="the pixel nearest to a voxel, or between four where they are of one surface (default: %(default)s)",
    )
    command.add_argument(
        "--weighting",
        choices=get_args(Weighting),
        default=defaults.integration.weighting,
        help="how much a pixel counts, by its depth or by the angle at which it sees (default: %(default)s)",
    )
    command.add_argument(
        "--drop-off",
        action=argparse.BooleanOptionalAction,
        default=defaults.integration.drop_off,
        help="let the weight fall to nothing behind the surface (default: it does)",
    )
    command.add_argument(
        "--weight-cap", type=float, metavar="W", help="the most a voxel's past counts, in frames (default: all)"
    )
    command.add_argument(
        "--min-weight",
        type=float,
        default=defaults.min_weight,
        metavar="W",
        help="mesh only what was seen more often (default: %(default)s)",
    )
    command.add_argument(
        "--storage",
        choices=get_args(Storage),
        default=defaults.storage,
        help="8 bytes a voxel, rounded, or 24, exact (default: %(default)s)",
    )


def _add_meshing(command: argparse.ArgumentParser) -> None:
    defaults = ReconstructionConfig()
    command.add_argument(
        "--mesher",
        choices=get_args(Mesher),
        default=defaults.mesher,
        help="marching cubes, or dual contouring, which keeps sharp edges (default: %(default)s)",
    )
    command.add_argument(
        "--oracle",
        choices=get_args(OracleName),
        help="what dual contouring goes by: the volume, or the depth images themselves, sharper and slower "
        f"(default: {defaults.oracle})",
    )
    command.add_argument(
        "--flatness",
        type=float,
        default=defaults.flatness,
        metavar="VOXELS",
        help="let dual contouring merge cells where the surface is flat: how far off the mesh may be then, in voxels; "
        "0.05 spares most vertices, and their colours (default: %(default)s, a vertex a cell)",
    )


def _run(options: argparse.Namespace) -> None:
    check_meshing(options.mesher, oracle=options.oracle, flatness=options.flatness)
    config = ReconstructionConfig(
        voxel_size=options.voxel_size,
        truncation=options.truncation,
        depth_max=options.depth_max,
        frames=options.frames,
        device=options.device,
        storage=options.storage,
        min_weight=options.min_weight,
        integration=Integration(
            depth_sampling=options.depth_sampling,
            weighting=options.weighting,
            drop_off=options.drop_off,
            weight_cap=options.weight_cap,
        ),
        mesher=options.mesher,
        oracle=options.oracle or ReconstructionConfig.oracle,
        flatness=options.flatness,
        depth_layer=options.depth,
    )
    dataset = open_dataset(options.dataset)
    watch = None
    if options.snapshots is not None:
        watch = Snapshots(options.snapshots, count=options.snapshot_count)
    with reporting(options) as progress:
        result = reconstruct(dataset, options.out, config, progress=progress, watch=watch)
    if options.json:
        print_json(result.record.model_dump(mode="json"))
    else:
        _print_record(result.record, config, options.out)


def _print_record(record: ReconstructionRecord, config: ReconstructionConfig, folder: Path) -> None:
    voxel_origin = "" if config.voxel_size else " (from the data)"
    truncation_origin = "" if config.truncation else " (4 voxels)"
    size = [high - low for low, high in zip(*record.bounds_m, strict=True)]
    lines = {
        "voxel size": f"{record.voxel_size_m:g} m{voxel_origin}",
        "truncation": f"{record.truncation_m:g} m{truncation_origin}",
        "bounds": " × ".join(f"{side:.2f}" for side in size) + f" m, {record.blocks:,} blocks",
        "fused": f"{record.frames} frames on {record.device} at {record.frames_per_second:.0f} frames/s, "
        f"{record.frames_per_second_with_decoding:.0f} with decoding",
        "voxels": f"{record.voxels_observed:,} observed, {record.voxel_updates:,} updates",
        "seconds": ", ".join(f"{name} {seconds:.2f}" for name, seconds in record.seconds if name != "decode")
        + f"; beside these, threads decoded for {record.seconds.decode:.2f}",
        "mesh": f"{record.vertices:,} vertices, {record.triangles:,} triangles",
        "peak memory": f"{record.peak_memory_mb:.0f} MiB",
        "written": str(folder),
    }
    table = Table.grid(padding=(0, 2))
    for name, text in lines.items():
        table.add_row(name, text)
    Console().print(table)
    if record.metrics is not None:
        print_metrics(record.metrics)
