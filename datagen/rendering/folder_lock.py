"""One render at a time in a folder, or several of different frames."""

import contextlib
import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from datagen.atomic_write import require_writable
from datagen.errors import InputError

try:
    fcntl: Any = importlib.import_module("fcntl")
except ImportError:  # Windows: two renders in one folder are not noticed there
    fcntl = None

LOCK_FILE = ".rendering.lock"


class Claim:
    """Some frames of a dataset, locked against other processes."""

    def __init__(self, handle: int | None, frames: range) -> None:
        self._handle = handle
        self._frames = frames

    @contextmanager
    def alone(self) -> Iterator[bool]:
        """Tell whether no other process has a claim on the folder; if so none can make one while the block runs."""
        if self._handle is None:
            yield True
            return
        alone = _lock(self._handle, 0, 0)
        try:
            yield alone
        finally:
            if alone:
                if self._frames.start:
                    fcntl.lockf(self._handle, fcntl.LOCK_UN, self._frames.start, 0)
                fcntl.lockf(self._handle, fcntl.LOCK_UN, 0, self._frames.stop)


@contextmanager
def claiming(folder: Path, frames: range) -> Iterator[Claim]:
    """Claim ``frames`` of the dataset ``folder``, which is made, while the block runs.

    Each frame is one byte of a file that the kernel locks, so that a claim ends with its process, however that dies,
    and processes that render different frames of one folder do not get into each other's way. The last one removes
    the file, and the folder where that is all that was ever in it. Raises InputError where another process has one of
    the frames.
    """
    require_writable(folder)
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / LOCK_FILE
    handle = _open_locked(path, frames) if fcntl is not None else None
    claim = Claim(handle, frames)
    try:
        yield claim
    finally:
        with claim.alone() as alone:
            if alone:
                path.unlink(missing_ok=True)
        if handle is not None:
            os.close(handle)
        if is_new:
            with contextlib.suppress(OSError):
                folder.rmdir()


def _open_locked(path: Path, frames: range) -> int:
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        if not _lock(handle, frames.start, len(frames)):
            os.close(handle)
            raise InputError(
                f"{path.parent}: another process renders into this folder now; wait for it or end it "
                "(shards of one dataset may share a folder, the same frames may not)"
            )
        # Between opening and locking, another process may have ended and removed the file.
        if path.exists() and os.fstat(handle).st_ino == path.stat().st_ino:
            return handle
        os.close(handle)


def _lock(handle: int, start: int, length: int) -> bool:
    """Lock bytes, all from ``start`` on for length 0, and tell whether they were free."""
    try:
        fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB, length, start)
    except (BlockingIOError, PermissionError):
        return False
    return True
