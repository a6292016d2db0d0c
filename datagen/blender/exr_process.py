"""Reading EXR files from within a Blender application.

Such a Blender has an OpenEXR of its own, whose functions take the place of those that the Python module OpenEXR brings
along: reading a file ends in a crash. So another process reads it.
"""

import contextlib
import json
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

READER_MODULE = "datagen.blender.exr_reader"
ARCHIVE_SUFFIX, ANSWER_OK = ".npz", "ok"
"""As the reader has them, which cannot be imported here: it loads OpenEXR."""


def read_file(exr: Path) -> dict[str, NDArray[np.float32]]:
    """Return all channels of an EXR file, (H, W) each; for one thread at a time.

    Raises RuntimeError where the file cannot be read, or the process that reads has died; the next call starts another.
    """
    reader = _reader()
    assert reader.stdin is not None
    assert reader.stdout is not None
    archive = exr.with_suffix(ARCHIVE_SUFFIX)
    try:
        answer = _ask(reader.stdin, reader.stdout, exr)
        if not answer:
            end_reader()
            raise RuntimeError(f"{exr.name}: the process that reads EXR files ended; render the frame again")
        if answer != ANSWER_OK:
            raise RuntimeError(f"{exr.name}: {answer}")
        with np.load(archive) as channels:
            return dict(channels)
    finally:
        archive.unlink(missing_ok=True)


def end_reader() -> None:
    """End the process that reads, where there is one."""
    if not _reader.cache_info().currsize:
        return
    reader = _reader()
    _reader.cache_clear()
    reader.kill()
    with contextlib.suppress(OSError):
        reader.communicate()


def _ask(questions: IO[str], answers: IO[str], exr: Path) -> str:
    """Return what the reader says of a file, nothing where it is dead."""
    try:
        questions.write(json.dumps(str(exr)) + "\n")
        questions.flush()
    except OSError:  # a broken pipe, which Windows calls otherwise
        return ""
    return answers.readline().strip()


@cache
def _reader() -> subprocess.Popen[str]:
    """Start the process that reads, once; it ends with this one, as its input does then."""
    return subprocess.Popen(  # noqa: S603 - our own module
        [sys.executable, "-m", READER_MODULE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, encoding="utf-8"
    )
