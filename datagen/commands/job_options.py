"""Options of long commands that other programs, such as the Blender extension, start and watch."""

import argparse
from contextlib import AbstractContextManager, nullcontext

from datagen.progress import ProgressReporter, as_json_lines, on_terminal


def add_job_options(command: argparse.ArgumentParser) -> None:
    """Add ``--progress`` and ``--end-with-input``."""
    command.add_argument(
        "--progress",
        choices=("bar", "json"),
        default="bar",
        help="a bar, or for programs one JSON object a line (stage, done, total), on standard error",
    )
    command.add_argument(
        "--end-with-input",
        action="store_true",
        help="end, as by Ctrl-C, when standard input ends: with the program that started this one",
    )


def reporting(options: argparse.Namespace) -> AbstractContextManager[ProgressReporter]:
    """Return what shows progress while a block runs, in the way of ``--progress``."""
    return nullcontext(as_json_lines) if options.progress == "json" else on_terminal()
