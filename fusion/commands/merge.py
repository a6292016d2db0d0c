"""``fusion merge``: one reconstruction of several."""

import argparse
from pathlib import Path
from typing import Any

from datagen.progress import on_terminal
from fusion.commands.arguments import add_device, add_json, add_remeshing, print_record
from fusion.edit_reconstruction import merge_reconstructions


def add_command(commands: Any) -> None:
    """Add the command to the parser's ``commands``."""
    command = commands.add_parser("merge", help="make one of reconstructions from different frames of a dataset")
    command.add_argument("reconstructions", type=Path, nargs="+", help="folders that fusion reconstruct wrote")
    command.add_argument("out", type=Path, help="the folder to write")
    add_remeshing(command)
    add_device(command)
    add_json(command)
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
    with on_terminal() as progress:
        record = merge_reconstructions(
            options.reconstructions,
            options.out,
            mesher=options.mesher,
            oracle=options.oracle,
            device=options.device,
            progress=progress,
        )
    print_record(options, record)
