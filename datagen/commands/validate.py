"""``datagen validate``: is a dataset what it says it is?"""

import argparse
import json
from pathlib import Path

from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from datagen.commands.arguments import add_frames, add_json
from datagen.dataset_check.check import check_dataset
from datagen.dataset_check.findings import CheckReport, Finding
from datagen.frame_selection import select_frames
from datagen.open_dataset import open_dataset
from datagen.progress import on_terminal

EXIT_FAULTS = 1


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    command.description = (
        "Reproject frames into each other and into the true mesh, where there is one, and name what is wrong: half "
        "pixels, axes, inverse poses, ray distances, scales, focal lengths, colour beside depth, poses of other "
        "frames, damaged files. The exit code is 0 without faults, 1 with, 2 where nothing can be used."
    )
    command.add_argument("dataset", metavar="DATASET", type=Path, help="a dataset of any format that can be read")
    add_frames(command)
    command.add_argument("--seed", type=int, default=0, metavar="N", help="of which pixels are compared (default: 0)")
    add_json(command)
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    dataset = open_dataset(options.dataset)
    frame_ids = select_frames(dataset.frame_ids, options.frames)
    with on_terminal() as progress:
        report = check_dataset(dataset, frame_ids, seed=options.seed, progress=progress)
    if options.json:
        print(json.dumps(report.as_json(), indent=2, allow_nan=False))
    else:
        _print(report)
    return EXIT_FAULTS if report.has_faults else 0


def _print(report: CheckReport) -> None:
    console = Console(highlight=False)
    console.print(Text(report.dataset, style="bold"))
    console.print(Padding(Text(_basis(report)), (0, 0, 0, 2)))
    for finding in report.findings:
        console.print()
        console.print(_paragraph(finding))
    console.print()
    faults = sum(finding.severity == "fault" for finding in report.findings)
    verdict = f"{faults} fault{'' if faults == 1 else 's'}" if faults else "no faults"
    console.print(Text(verdict, style="bold red" if faults else "bold green"))


def _paragraph(finding: Finding) -> Padding:
    style = "bold red" if finding.severity == "fault" else "bold yellow"
    text = Text.assemble((f"{finding.severity}: {finding.kind}", style), "\n", finding.message, "\n")
    text.append(f"→ {finding.remedy}", style="italic")
    return Padding(text, (0, 0, 0, 2))


def _basis(report: CheckReport) -> str:
    basis = report.basis
    parts = [f"{basis['frames_read']} frames read"]
    if frames := basis.get("frames"):
        parts.append(
            f"{frames['blocks']} reprojections between {basis['frames_compared']} of them: {frames['median']} in the "
            f"median, {frames['agreement']:.0%} on the same surface"
        )
    if mesh := basis.get("mesh"):
        parts.append(f"against the true mesh: {mesh['median']} in the median, {mesh['agreement']:.0%} on the surface")
    return "; ".join(parts)
