"""``fusion merge``: one reconstruction of several."""

import argparse
from pathlib import Path

from datagen.commands.arguments import add_json
from datagen.progress import on_terminal
from fusion.commands.arguments import add_device, add_out_folder, add_remeshing, print_record
from fusion.edit_reconstruction import merge_reconstructions


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    command.add_argument(
        "reconstructions", metavar="RECONSTRUCTION", type=Path, nargs="+", help="folders that fusion reconstruct wrote"
    )
    add_out_folder(command)
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
            flatness=options.flatness,
            device=options.device,
            progress=progress,
        )
    print_record(options, record)
