"""``fusion pose-benchmark``: how well new views are located, by a protocol with bars."""

import argparse
import sys
from pathlib import Path
from typing import get_args

from rich.console import Console
from rich.table import Table

from datagen.commands.arguments import add_json
from datagen.errors import InputError
from datagen.interrupts import interrupts_held
from datagen.progress import on_terminal
from fusion.commands.arguments import add_device, add_out_folder, add_voxel_size, print_json
from fusion.pose_benchmark.object_box import ObjectBox
from fusion.pose_benchmark.protocol import TRIAL_NAMES, parse_trials
from fusion.pose_benchmark.subjects import Kind
from fusion.pose_benchmark.summary import Row, rows_as_json
from fusion.reconstruction_config import check_length


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    command.add_argument(
        "dataset",
        metavar="DATASET",
        type=Path,
        nargs="+",
        help="datasets, or a folder of YCB-Video's frames and models",
    )
    add_out_folder(command, resumed=True)
    command.add_argument(
        "--protocol",
        choices=get_args(Kind),
        help="what the data are; without it a dataset with a true mesh is an object, another one a room",
    )
    command.add_argument("--trials", metavar="A,B", help=f"only these: {', '.join(TRIAL_NAMES)}")
    command.add_argument(
        "--fuse",
        metavar="START:STOP:STEP",
        help="the frames to fuse (default: all but every fifth of an object, every tenth of a room)",
    )
    command.add_argument(
        "--frames", metavar="START:STOP:STEP", help="a Python slice over the frames that are not fused (default: all)"
    )
    add_voxel_size(command)
    command.add_argument(
        "--box",
        type=float,
        nargs=6,
        metavar=("X", "Y", "Z", "X", "Y", "Z"),
        help="where in the world the object is, its low and its high corner, metres: all else is masked",
    )
    command.add_argument(
        "--seed", type=int, default=0, metavar="N", help="of starts, noise and occluders (default: %(default)s)"
    )
    add_device(command)
    add_json(command)
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
    try:
        with interrupts_held():  # trimesh, as in datagen.commands.command_line
            from fusion.pose_benchmark.benchmark import BenchmarkConfig, run_benchmark  # noqa: PLC0415 - needs an extra
    except ModuleNotFoundError as error:
        raise InputError(
            f'histograms need the Python module {error.name}, which is not installed: pip install "scanback[preview]"'
        ) from error
    if options.voxel_size is not None:
        check_length("--voxel-size", options.voxel_size)
    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: expected 0 or more")
    config = BenchmarkConfig(
        protocol=options.protocol,
        trials=parse_trials(options.trials),
        fuse=options.fuse,
        frames=options.frames,
        voxel_size=options.voxel_size,
        box=None if options.box is None else ObjectBox(low=tuple(options.box[:3]), high=tuple(options.box[3:])),
        seed=options.seed,
        device=options.device,
    )
    try:
        with on_terminal() as progress:
            outcome = run_benchmark(options.dataset, options.out, config, progress=progress)
    except KeyboardInterrupt:
        print("fusion: interrupted; the same command goes on", file=sys.stderr)
        raise SystemExit(130) from None
    if options.json:
        print_json(rows_as_json(outcome.rows))
    else:
        _print_rows(outcome.rows)
        print(outcome.page)


def _print_rows(rows: tuple[Row, ...]) -> None:
    console = Console()
    for subject in dict.fromkeys(row.subject for row in rows):
        table = Table("trial", "cases", "what", "bar", "reached", "", box=None, title=subject, title_justify="left")
        title = None
        for row in (row for row in rows if row.subject == subject):
            first = row.title != title
            title = row.title
            color = {True: "green", False: "bold red", None: "dim"}[row.passed]
            table.add_row(
                row.title if first else "",
                str(row.cases) if first else "",
                row.what,
                row.bar,
                f"[{color}]{row.reached_in_words}[/]",
                f"[{color}]{row.verdict}[/]",
            )
        console.print(table)
