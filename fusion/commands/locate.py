"""``fusion locate``: the nearest fused pose of each frame."""

import argparse
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from datagen.commands.job_options import add_job_options, reporting
from datagen.open_dataset import open_dataset
from fusion.commands.arguments import (
    add_depth_layer,
    add_device,
    add_frames,
    add_json,
    add_reconstruction,
    print_json,
)
from fusion.pose.locate import locate
from fusion.reconstruction_files import LocatedPose, poses_as_json


def add_command(commands: Any) -> None:
    """Add the command to the parser's ``commands``."""
    command = commands.add_parser("locate", help="find the nearest fused pose of each frame")
    add_reconstruction(command)
    command.add_argument("dataset", type=Path, help="where the query frames are")
    command.add_argument(
        "--stages",
        default="nearest",
        metavar="A,B",
        help="nearest, then what refines the pose: epipolar, silhouette, depth (default: nearest alone)",
    )
    add_depth_layer(command)
    add_frames(command)
    add_device(command)
    add_json(command)
    add_job_options(command)
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
    dataset = open_dataset(options.dataset)
    if options.depth is not None:
        dataset = dataset.with_depth_layer(options.depth)
    with reporting(options) as progress:
        located = locate(
            options.reconstruction,
            dataset,
            frames=options.frames,
            stages=options.stages,
            device=options.device,
            progress=progress,
        )
    for frame, reason in located.failures.items():
        print(f"fusion: note: frame {frame} was not located: {reason}", file=sys.stderr)
    if options.json:
        print_json(poses_as_json(located.poses))
    else:
        _print_poses(located.poses)


def _print_poses(poses: list[LocatedPose]) -> None:
    refined = any(pose.refined is not None for pose in poses)
    columns = ("query", "nearest", "score (mm²)", "rotation error (°)", "translation error (m)")
    table = Table(*columns, *(("verdict", "refined (°)", "refined (mm)") if refined else ()), box=None)
    for pose in poses:
        score = f"{1e6 * pose.score:.3f}{' (ambiguous)' if pose.ambiguous else ''}"
        row = [str(pose.query), str(pose.nearest), score]
        row += [_number(pose.rotation_error_deg, 2), _number(pose.translation_error_m, 4)]
        if pose.refined is not None:
            millimetres = pose.refined.translation_error_m and 1000 * pose.refined.translation_error_m
            row += [pose.refined.verdict, _number(pose.refined.rotation_error_deg, 3), _number(millimetres, 2)]
        table.add_row(*row)
    Console().print(table)


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"
