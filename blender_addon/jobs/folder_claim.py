"""One Blender at a time works in the folder of a scan: two would mix what they write there."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from ..errors import ReconstructionError
from .file_lock import FileLock, TakenError
from .job import Job, Work

CLAIM_FILE = ".scanback.lock"
_Result = TypeVar("_Result")


@contextlib.contextmanager
def claiming(folder: Path, *, makes: bool = False) -> Iterator[None]:
    """Claim a folder while the block runs; ``makes`` has it made, and removed again where nothing came into it.

    The claim goes when the process does, however that dies. Where the file system has no locks, or nothing can be
    written, there is none. Raises ReconstructionError where another process has it.
    """
    is_new = makes and not _is_there(folder)
    if is_new:
        with contextlib.suppress(OSError):  # who writes there will tell
            folder.mkdir(parents=True, exist_ok=True)
    lock = _lock(folder)
    try:
        yield
    finally:
        if lock is not None:
            lock.release()
        if is_new:
            with contextlib.suppress(OSError):
                folder.rmdir()


def while_claimed(
    folder: Path, work: Callable[[Job], Work[_Result]], *, makes: bool = False
) -> Callable[[Job], Work[_Result]]:
    """Return ``work`` with the claim on a folder for as long as it runs."""

    def claimed(job: Job) -> Work[_Result]:
        with claiming(folder, makes=makes):
            return (yield from work(job))

    return claimed


def _is_there(folder: Path) -> bool:
    try:
        return folder.exists()
    except OSError:
        return True


def _lock(folder: Path) -> FileLock | None:
    try:
        return FileLock(folder / CLAIM_FILE)
    except TakenError:
        raise ReconstructionError(
            f"{folder}: another Blender is at work in this folder; wait until it is done, or choose another folder"
        ) from None
    except OSError:
        return None
