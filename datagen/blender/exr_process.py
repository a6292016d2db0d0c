"""Reading EXR files from within a Blender application.

Such a Blender has an OpenEXR of its own, whose functions take the place of those that the Python module OpenEXR brings
along: reading a file ends in a crash. So another process reads it.
"""

import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

READER_MODULE = "datagen.blender.exr_reader"


def read_file(exr: Path) -> dict[str, NDArray[np.float32]]:
    """Return all channels of an EXR file, (H, W) each; for one thread at a time."""
    reader = _reader()
    assert reader.stdin is not None
    assert reader.stdout is not None
    reader.stdin.write(f"{exr}\n")
    reader.stdin.flush()
    answer = reader.stdout.readline().strip()
    if answer != "ok":
        raise RuntimeError(f"{exr.name}: {answer or 'the process that reads EXR files ended'}")
    archive = exr.with_suffix(".npz")
    with np.load(archive) as channels:
        found = dict(channels)
    archive.unlink()
    return found


@cache
def _reader() -> subprocess.Popen[str]:
    """Start the process that reads, once; it ends with this one, as its input does then."""
    return subprocess.Popen(  # noqa: S603 - our own module
        [sys.executable, "-m", READER_MODULE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
