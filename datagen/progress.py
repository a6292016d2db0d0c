"""Progress of long work, reported by the library and drawn by the command line."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


class ProgressReporter(Protocol):
    """Takes a stage's name and number of steps, and gives back what to call after each step."""

    def __call__(self, stage: str, total: int) -> Callable[[], None]:
        """Begin ``stage``; the result advances it by one step."""


def silent(stage: str, total: int) -> Callable[[], None]:  # noqa: ARG001
    """Report nothing."""
    return lambda: None


def as_json_lines(stage: str, total: int) -> Callable[[], None]:
    """Write one JSON object a line on standard error as ``stage`` begins and after each step: for programs."""
    done = 0

    def write() -> None:
        sys.stderr.write(json.dumps({"stage": stage, "done": done, "total": total}) + "\n")
        sys.stderr.flush()

    def advance() -> None:
        nonlocal done
        done += 1
        write()

    write()
    return advance


@contextmanager
def on_terminal() -> Iterator[ProgressReporter]:
    """Draw a bar with the time left for each stage, on standard error, so that standard output stays for results."""
    columns = (
        TextColumn("{task.description:<12}"),
        BarColumn(),
        TaskProgressColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    progress = Progress(*columns, console=Console(stderr=True))

    def report(stage: str, total: int) -> Callable[[], None]:
        progress.start()  # not before: what fails at once, or has nothing to do, draws no empty line
        task = progress.add_task(stage, total=total)
        return lambda: progress.advance(task)

    try:
        yield report
    finally:
        if progress.tasks:
            progress.stop()
