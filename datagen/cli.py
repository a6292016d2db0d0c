"""The command line ``datagen``: render a scene, tell what a dataset holds."""

import argparse
import sys
from collections.abc import Sequence

from datagen.commands import convert, info, lens, merge, pointcloud, preview, render, sensor, validate, verify
from datagen.commands.job_options import watch_parent
from datagen.errors import InputError, WorkerError

COMMANDS = (render, info, sensor, lens, convert, verify, merge, pointcloud, validate, preview)

EXIT_FAILURE = 1
EXIT_INPUT_ERROR = 2
EXIT_INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    options = _parser().parse_args(arguments)
    try:
        watch_parent(options)
        return options.run(options) or 0
    except InputError as error:
        print(f"datagen: error: {error}", file=sys.stderr)
        return EXIT_INPUT_ERROR
    except WorkerError as error:
        print(f"datagen: error: {error}", file=sys.stderr)
        return EXIT_FAILURE
    except KeyboardInterrupt:
        print("datagen: interrupted; what is finished is kept, and the same command goes on there", file=sys.stderr)
        return EXIT_INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="datagen", description="Make and look at posed RGB-D datasets.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add_command(commands)
    return parser
