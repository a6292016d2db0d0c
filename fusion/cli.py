"""The ``fusion`` command: reconstruct, locate, evaluate, and what ``fusion.volume_cli`` adds."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

from rich.console import Console
from rich.table import Table

from datagen.errors import InputError
from datagen.frame_selection import select_frames
from datagen.open_dataset import open_dataset
from datagen.progress import on_terminal
from fusion.commands import mesh, report
from fusion.devices import resolve_device
from fusion.evaluation.evaluate import Observers, evaluate
from fusion.integration.options import DepthSampling, Integration, Weighting
from fusion.pose.locate import locate
from fusion.reconstruct import reconstruct
from fusion.reconstruction_config import ReconstructionConfig, check_length
from fusion.reconstruction_files import RECORD_FILE, LocatedPose, ReconstructionRecord, poses_as_json, read_record
from fusion.surface.mesh_files import read_mesh
from fusion.surface.meshers import Mesher, OracleName
from fusion.volume.voxels import Storage
from fusion.volume_cli import add_volume_commands


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code: 0, 2 for input that cannot be used, 130 where interrupted."""
    options = _parser().parse_args(arguments)
    try:
        options.run(options)
    except InputError as error:
        print(f"fusion: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("fusion: interrupted; the same command begins anew", file=sys.stderr)
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="fusion", description="Fuse posed RGB-D frames and locate new ones.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    command = commands.add_parser("reconstruct", help="fuse a dataset into a coloured mesh")
    command.add_argument("dataset", type=Path, help="a Scanback dataset or a 7-Scenes sequence")
    command.add_argument("out", type=Path, help="the folder to write")
    command.add_argument("--voxel-size", type=float, metavar="M", help="metres; from the data if not given")
    command.add_argument("--truncation", type=float, metavar="M", help="metres; 4 voxels if not given")
    command.add_argument("--depth-max", type=float, metavar="M", help="take farther depths as invalid")
    _add_depth_layer(command)
    _add_integration(command)
    _add_meshing(command)
    _add_shared(command)
    command.set_defaults(run=_reconstruct)

    command = commands.add_parser("locate", help="find the nearest fused pose of each frame")
    command.add_argument("reconstruction", type=Path, help="a folder that fusion reconstruct wrote")
    command.add_argument("dataset", type=Path, help="where the query frames are")
    _add_depth_layer(command)
    _add_shared(command)
    command.set_defaults(run=_locate)

    command = commands.add_parser("evaluate", help="measure a mesh against the truth")
    command.add_argument("mesh", type=Path)
    command.add_argument("ground_truth", type=Path, help="a mesh, or a dataset that has one")
    command.add_argument(
        "--observed-by",
        type=Path,
        metavar="DATASET",
        help="cull the truth to what its frames saw, not to what the mesh's record says",
    )
    command.add_argument("--threshold", type=float, action="append", metavar="M", help="of the F-score; repeatable")
    command.add_argument("--voxel-size", type=float, metavar="M", help="to give lengths in voxels too")
    _add_shared(command)
    command.set_defaults(run=_evaluate)

    add_volume_commands(commands)
    mesh.add_command(commands)
    report.add_command(commands)
    return parser


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
        help="let the weight fall to nothing behind the surface (default: %(default)s)",
    )
    command.add_argument("--weight-cap", type=float, metavar="W", help="the most a voxel's past counts, in frames")
    command.add_argument(
        "--min-weight", type=float, default=defaults.min_weight, metavar="W", help="mesh only what was seen more often"
    )
    command.add_argument(
        "--storage",
        choices=get_args(Storage),
        default=defaults.storage,
        help="8 bytes a voxel, rounded, or 24, exact (default: %(default)s)",
    )


def _add_depth_layer(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--depth", metavar="LAYER", help="a layer of the dataset in the place of its depth: sensor_depth"
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
        default=defaults.oracle,
        help="what dual contouring goes by: the volume, or the depth images themselves, sharper and slower "
        "(default: %(default)s)",
    )


def _add_shared(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--frames",
        metavar="START:STOP:STEP",
        help="a Python slice over the frames; --frames=-20: if it begins with a minus",
    )
    command.add_argument("--device", default="auto", metavar="auto|cpu|cuda[:N]")
    command.add_argument("--json", action="store_true", help="print the result as JSON, and nothing else")


def _reconstruct(options: argparse.Namespace) -> None:
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
        oracle=options.oracle,
        depth_layer=options.depth,
    )
    dataset = open_dataset(options.dataset)
    with on_terminal() as progress:
        result = reconstruct(dataset, options.out, config, progress=progress)
    if options.json:
        _print_json(result.record.model_dump(mode="json"))
    else:
        _print_record(result.record, config, options.out)


def _locate(options: argparse.Namespace) -> None:
    dataset = open_dataset(options.dataset)
    if options.depth is not None:
        dataset = dataset.with_depth_layer(options.depth)
    with on_terminal() as progress:
        located = locate(
            options.reconstruction, dataset, frames=options.frames, device=options.device, progress=progress
        )
    for frame, reason in located.failures.items():
        print(f"fusion: note: frame {frame} was not located: {reason}", file=sys.stderr)
    if options.json:
        _print_json(poses_as_json(located.poses))
    else:
        _print_poses(located.poses)


def _evaluate(options: argparse.Namespace) -> None:
    for option, values in (("--threshold", options.threshold or []), ("--voxel-size", [options.voxel_size])):
        for value in values:
            if value is not None:
                check_length(option, value)
    # A reconstruction knows its voxel size and the frames that observed it.
    folder = options.mesh.parent
    record = read_record(folder) if (folder / RECORD_FILE).is_file() else None
    voxel_size = options.voxel_size or (record.voxel_size_m if record else None)
    thresholds = options.threshold or ([voxel_size / 2, voxel_size] if voxel_size else None)
    if thresholds is None:
        raise InputError(f"{options.mesh}: its voxel size is not known; give --voxel-size or --threshold")
    ours, ground_truth = read_mesh(options.mesh), read_mesh(_ground_truth_file(options.ground_truth))
    with on_terminal() as progress:
        metrics = evaluate(
            ours,
            ground_truth,
            thresholds=thresholds,
            device=resolve_device(options.device),
            observed_by=_observers(options, folder, record),
            voxel_size=voxel_size,
            progress=progress,
        )
    if options.json:
        _print_json(metrics)
    else:
        _print_metrics(metrics)


def _ground_truth_file(path: Path) -> Path:
    if not path.is_dir():
        return path
    truth = open_dataset(path).ground_truth_mesh
    if truth is None:
        raise InputError(f"{path}: this dataset has no ground-truth mesh; name a mesh file")
    return truth


def _observers(options: argparse.Namespace, folder: Path, record: ReconstructionRecord | None) -> Observers | None:
    """Return the frames to cull the truth to: those asked for, else those that the mesh was made of."""
    dataset_folder = options.observed_by or (options.ground_truth if options.ground_truth.is_dir() else None)
    if record is not None and options.frames is None:
        recorded = folder / record.dataset
        if recorded.is_dir() and dataset_folder in (None, options.ground_truth, recorded):
            fused = tuple(frame.frame for frame in record.trajectory)
            return Observers(dataset=open_dataset(recorded), frame_ids=fused, depth_max=record.depth_max_m)
    if dataset_folder is None:
        return None
    dataset = open_dataset(dataset_folder)
    return Observers(dataset=dataset, frame_ids=select_frames(dataset.frame_ids, options.frames))


def _print_json(value: Any) -> None:
    print(json.dumps(value, indent=2, allow_nan=False))


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
        _print_metrics(record.metrics)


def _print_metrics(metrics: dict[str, Any]) -> None:
    table = Table.grid(padding=(0, 2))
    for name in ("accuracy", "completeness", "chamfer"):
        voxels = f" ({metrics[f'{name}_voxels']:.3f} voxels)" if f"{name}_voxels" in metrics else ""
        table.add_row(name, f"{1000 * metrics[f'{name}_m']:.4f} mm{voxels}")
    for entry in metrics["fscores"]:
        table.add_row(f"F-score at {1000 * entry['threshold_m']:.3g} mm", f"{100 * entry['fscore']:.2f} %")
    table.add_row("normal consistency", f"{metrics['normal_consistency']:.4f}")
    Console().print(table)


def _print_poses(poses: list[LocatedPose]) -> None:
    table = Table("query", "nearest", "score (mm²)", "rotation error (°)", "translation error (m)", box=None)
    for pose in poses:
        rotation = "–" if pose.rotation_error_deg is None else f"{pose.rotation_error_deg:.2f}"
        translation = "–" if pose.translation_error_m is None else f"{pose.translation_error_m:.4f}"
        table.add_row(str(pose.query), str(pose.nearest), f"{1e6 * pose.score:.3f}", rotation, translation)
    Console().print(table)
