"""Folders in memory through which images come, and the removal of those whose processes are dead."""

import contextlib
import importlib
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

try:
    fcntl: Any = importlib.import_module("fcntl")
except ImportError:  # Windows has neither these locks nor a folder in memory
    fcntl = None

MEMORY_FOLDER = Path("/dev/shm")  # noqa: S108 - only subfolders of its own, made by tempfile, are used
PREFIX = "scanback-"
SETTLING_SECONDS = 60.0
"""A folder younger than this may not be held yet by the process that made it."""


def make_scratch(bytes_needed: int) -> Path:
    """Return a new folder: in memory where that has room to spare for ``bytes_needed`` (containers make it small)."""
    in_memory = MEMORY_FOLDER.is_dir() and shutil.disk_usage(MEMORY_FOLDER).free >= 3 * bytes_needed
    return Path(tempfile.mkdtemp(prefix=PREFIX, dir=MEMORY_FOLDER if in_memory else None))


@contextmanager
def hold(scratch: Path) -> Iterator[None]:
    """Keep ``scratch`` from being removed by others for as long as this process lives, or until the block ends.

    Several processes may hold one folder. The hold is a lock of the kernel's, which goes when the process does,
    however it dies.
    """
    if fcntl is None:
        yield
        return
    handle = os.open(scratch, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_SH)
        yield
    finally:
        os.close(handle)


def remove_abandoned_scratch(*, parents: tuple[Path, ...] = ()) -> None:
    """Remove scratch folders, of this user's, that nobody holds: their processes were killed."""
    if fcntl is None:
        return
    for parent in parents or (MEMORY_FOLDER, Path(tempfile.gettempdir())):
        for folder in parent.glob(f"{PREFIX}*"):
            with contextlib.suppress(OSError):
                if folder.is_dir() and time.time() - folder.stat().st_mtime > SETTLING_SECONDS:
                    _remove_unless_held(folder)


def _remove_unless_held(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(handle)
