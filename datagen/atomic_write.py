"""Files that exist whole or not at all."""

import contextlib
import json
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from datagen.errors import InputError

TEMPORARY_PREFIX = ".unfinished-"
READER_SECONDS = 2.0
"""How long a reader may have a file open that is to be replaced; that is in nobody's way but on Windows."""


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in ``path``'s folder; it takes ``path``'s name when the block ends without an error.

    The temporary name keeps ``path``'s suffix, so that writers which go by the suffix can be given it. A reader sees
    the old file or the new one, whatever moment the process dies at. Raises InputError where the folder cannot be
    written to or the disk is full.
    """
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=TEMPORARY_PREFIX, suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        _take_place(temporary, path)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); check the folder's permissions and free space"
        ) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def _take_place(temporary: Path, path: Path) -> None:
    """Give ``temporary`` the name ``path``; on Windows it waits for a reader that has the old file open."""
    end = time.monotonic() + READER_SECONDS
    while True:
        try:
            temporary.replace(path)
        except PermissionError:
            if time.monotonic() > end or not path.is_file():
                raise
            time.sleep(0.02)
        else:
            return


def write_bytes(path: Path, data: bytes) -> None:
    """Write ``data`` to ``path`` atomically."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` to ``path`` atomically as indented JSON; NaN and infinity are refused, as JSON has neither."""
    write_bytes(path, (json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


def require_writable(folder: Path) -> None:
    """Raise InputError unless ``folder``, there or still to be made, can be written to; nothing is made."""
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if os.path.lexists(path))
    if not existing.is_dir():
        raise InputError(f"{folder}: {existing} is a file, not a folder; name another place to write to")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: {existing} cannot be written to; name another place, or change its permissions")


def remove_unfinished(folder: Path) -> None:
    """Delete the temporary files that a killed process left in ``folder``."""
    for leftover in folder.glob(f"{TEMPORARY_PREFIX}*"):
        leftover.unlink(missing_ok=True)
