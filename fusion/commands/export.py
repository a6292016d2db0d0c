"""``fusion export``: a volume in formats of other tools."""

import argparse
from pathlib import Path

from datagen.commands.arguments import add_json
from datagen.progress import on_terminal
from fusion.commands.arguments import add_device, add_reconstruction, add_remeshing, print_result
from fusion.export import export


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    add_reconstruction(command)
    command.add_argument("out", metavar="OUT", type=Path, help="a file whose name ends in .ply or .vdb")
    command.add_argument("--points", action="store_true", help="points, not a mesh (.ply)")
    command.add_argument(
        "--min-weight", type=float, metavar="W", help="only where more was seen (.ply) (default: as it was meshed)"
    )
    add_remeshing(command)
    add_device(command)
    add_json(command)
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
    with on_terminal() as progress:
        written = export(
            options.reconstruction,
            options.out,
            points=options.points,
            min_weight=options.min_weight,
            mesher=options.mesher,
            oracle=options.oracle,
            flatness=options.flatness,
            device=options.device,
            progress=progress,
        )
    print_result(options, {"file": str(options.out), "written": written}, f"{options.out}: {written}")
