"""A lock of the system's on a file: it goes when its process does, however that dies."""

import contextlib
import importlib
import os
from pathlib import Path
from typing import Any

try:
    fcntl: Any = importlib.import_module("fcntl")
except ImportError:  # Windows
    fcntl = None


class TakenError(OSError):
    """Another process, or another lock of this one, has the file."""


class FileLock:
    """A file that nobody else can lock until ``release``."""

    def __init__(self, path: Path, *, create: bool = True) -> None:
        """Lock it; ``create`` makes it where it is not there.

        Raises TakenError where it is locked, and another OSError where it cannot be opened or the file system has no
        locks.
        """
        self._path = path
        self._handle: int | None = _open_locked(path, os.O_RDWR | (os.O_CREAT if create else 0))

    def release(self) -> None:
        """Remove the file and let go of it; again does nothing."""
        handle, self._handle = self._handle, None
        if handle is None:
            return
        with contextlib.suppress(OSError):
            if fcntl is not None:  # before others can lock it
                self._path.unlink(missing_ok=True)
        os.close(handle)
        if fcntl is None:  # Windows removes no file that is open
            with contextlib.suppress(OSError):
                self._path.unlink(missing_ok=True)


def _open_locked(path: Path, flags: int) -> int:
    while True:
        handle = os.open(path, flags, 0o666)
        try:
            _lock(handle, path)
            # Between opening and locking, another process may have ended and removed the file.
            if os.path.samestat(os.fstat(handle), path.stat()):
                return handle
        except FileNotFoundError:
            pass
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _lock(handle: int, path: Path) -> None:
    try:
        if fcntl is not None:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            msvcrt = importlib.import_module("msvcrt")
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
    except (BlockingIOError, PermissionError) as error:  # the one where there is fcntl, the other on Windows
        raise TakenError(f"{path}: is locked") from error
