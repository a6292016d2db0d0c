"""One Blender at a time works in the folder of a scan: two would mix what they write there."""

import contextlib
import importlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from ..errors import ReconstructionError
from .job import Job, Work

try:
    fcntl: Any = importlib.import_module("fcntl")
except ImportError:  # Windows
    fcntl = None

CLAIM_FILE = ".scanback.lock"
_Result = TypeVar("_Result")


@contextlib.contextmanager
def claiming(folder: Path, *, makes: bool = False) -> Iterator[None]:
    """Claim a folder while the block runs; ``makes`` has it made, and removed again where nothing came into it.

    The claim is a lock of the system's, which goes when the process does, however that dies. Where the file system has
    no locks, or nothing can be written, there is none. Raises ReconstructionError where another process has it.
    """
    is_new = makes and not _is_there(folder)
    if is_new:
        with contextlib.suppress(OSError):  # who writes there will tell
            folder.mkdir(parents=True, exist_ok=True)
    handle = _open_locked(folder / CLAIM_FILE)
    try:
        yield
    finally:
        if handle is not None:
            _let_go(folder / CLAIM_FILE, handle)
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


def _open_locked(path: Path) -> int | None:
    while True:
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError:
            return None
        try:
            _lock(handle)
            # Between opening and locking, another process may have ended and removed the file.
            if os.path.samestat(os.fstat(handle), path.stat()):
                return handle
        except FileNotFoundError:
            pass
        except (BlockingIOError, PermissionError):
            os.close(handle)
            raise ReconstructionError(
                f"{path.parent}: another Blender is at work in this folder; wait until it is done, or choose another "
                "folder"
            ) from None
        except OSError:  # no locks here
            os.close(handle)
            return None
        os.close(handle)


def _lock(handle: int) -> None:
    """Lock an open file; raises BlockingIOError, on Windows PermissionError, where another process has."""
    if fcntl is not None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    else:
        msvcrt = importlib.import_module("msvcrt")
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)


def _let_go(path: Path, handle: int) -> None:
    with contextlib.suppress(OSError):
        if fcntl is not None:  # before others can lock it
            path.unlink(missing_ok=True)
    os.close(handle)
    if fcntl is None:  # Windows removes no file that is open
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
