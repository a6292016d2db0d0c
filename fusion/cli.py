"""The command ``fusion``: reconstruct, locate, evaluate, and what is done to a reconstruction."""

import argparse
import sys
from collections.abc import Sequence

from datagen.commands.job_options import watch_parent
from datagen.errors import InputError
from fusion.commands import (
    crop,
    estimate,
    evaluate,
    export,
    locate,
    merge,
    mesh,
    pose_benchmark,
    reconstruct,
    render,
    report,
)

COMMANDS = (estimate, reconstruct, locate, evaluate, pose_benchmark, report, render, export, mesh, crop, merge)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code: 0, 2 for input that cannot be used, 130 where interrupted."""
    options = _parser().parse_args(arguments)
    try:
        watch_parent(options)
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
    for command in COMMANDS:
        command.add_command(commands)
    return parser
