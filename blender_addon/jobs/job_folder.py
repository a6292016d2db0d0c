"""The folder of a job, for files that nobody needs afterwards; those of dead Blenders are swept away."""

import contextlib
import shutil
import tempfile
import time
from pathlib import Path

from ..errors import ReconstructionError
from .file_lock import FileLock

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
        except OSError as error:
            raise ReconstructionError(
                f"{cache}: cannot be written ({error.strerror or error}); choose another cache folder in preferences"
            ) from error
        self._lock: FileLock | None = None
        with contextlib.suppress(OSError):  # a file system without locks: then nobody else gets one either
            self._lock = FileLock(self.path / HELD_FILE)

    def remove(self) -> None:
        """Remove it with all that is in it; again does nothing."""
        if self._lock is not None:
            self._lock.release()
        shutil.rmtree(self.path, ignore_errors=True)


def _remove_abandoned(cache: Path) -> None:
    for folder in cache.glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError):  # it is held, or removed by another Blender meanwhile
            if time.time() - folder.stat().st_mtime > SETTLING_SECONDS:
                with contextlib.suppress(FileNotFoundError):  # it was not even begun, or half removed
                    FileLock(folder / HELD_FILE, create=False).release()
                shutil.rmtree(folder, ignore_errors=True)
