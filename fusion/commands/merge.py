"""``fusion merge``: one reconstruction of several."""

import argparse
from pathlib import Path

from datagen.progress import on_terminal
from fusion.commands.arguments import add_device, add_json, add_remeshing, print_record
from fusion.edit_reconstruction import merge_reconstructions


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
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
