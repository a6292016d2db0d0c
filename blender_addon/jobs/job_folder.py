"""The folder of a job, for files that nobody needs afterwards; those of dead Blenders are swept away."""

import contextlib
import importlib
import os
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any, BinaryIO

from ..errors import ReconstructionError

try:
    fcntl: Any = importlib.import_module("fcntl")
except ImportError:  # Windows, where a file that is open cannot be removed
    fcntl = None

HELD_FILE = ".held"
PREFIX = "job-"
SETTLING_SECONDS = 60.0
"""A folder younger than this may not be held yet by the Blender that made it."""


class JobFolder:
    """A new folder in ``cache``, held by this process: however it dies, the system lets go, and others may remove it.

    A job that sleeps, with the whole machine for a week, keeps its folder.
    """

    def __init__(self, cache: Path) -> None:
        """Make it, and remove those that nobody holds. Raises ReconstructionError without a place."""
        try:
            cache.mkdir(parents=True, exist_ok=True)
            _remove_abandoned(cache)
            self.path = Path(tempfile.mkdtemp(prefix=PREFIX, dir=cache))
            self._held: BinaryIO = (self.path / HELD_FILE).open("wb")
        except OSError as error:
            raise ReconstructionError(
                f"{cache}: cannot be written ({error.strerror or error}); choose another cache folder in preferences"
            ) from error
        if fcntl is not None:
            with contextlib.suppress(OSError):  # a file system without locks: then nobody else gets one either
                fcntl.flock(self._held, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def remove(self) -> None:
        """Remove it with all that is in it; again does nothing."""
        self._held.close()
        shutil.rmtree(self.path, ignore_errors=True)


def _remove_abandoned(cache: Path) -> None:
    for folder in cache.glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError):  # another Blender may remove its own meanwhile
            if time.time() - folder.stat().st_mtime > SETTLING_SECONDS and _is_free(folder / HELD_FILE):
                shutil.rmtree(folder, ignore_errors=True)


def _is_free(held: Path) -> bool:
    """Tell whether no process holds a folder by this file. Raises OSError where that cannot be told."""
    try:
        if fcntl is None:
            held.unlink()
            return True
        handle = os.open(held, os.O_RDWR)
    except FileNotFoundError:  # it was not even begun, or half removed
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    finally:
        os.close(handle)
    return True
