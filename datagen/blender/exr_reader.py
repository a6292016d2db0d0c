"""Reading EXR files; ``python -m datagen.blender.exr_reader`` does it for a process that must not load OpenEXR.

Standard input brings a path a line, as JSON, which holds any path whatever the locale; the channels go into a NumPy
archive beside the file, and standard output says ``ok`` then, or what is wrong.
"""

import json
import os
import sys
from pathlib import Path

import numpy as np
import OpenEXR
from numpy.typing import NDArray

ARCHIVE_SUFFIX = ".npz"


def read_file(exr: Path) -> dict[str, NDArray[np.float32]]:
    """Return all channels of an EXR file, (H, W) each. Blender 4.5 writes one part, 5.0 may write several."""
    with OpenEXR.File(str(exr), separate_channels=True) as file:
        return {name: channel.pixels for part in file.parts for name, channel in part.channels.items()}


def main() -> None:
    """Serve one process until it closes standard input."""
    # What the libraries print goes to standard error: the pipe to the other process is for answers.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8", errors="replace")
    os.dup2(2, 1)
    for line in sys.stdin:
        try:
            exr = Path(json.loads(line))
            channels = read_file(exr)
            np.savez(exr.with_suffix(ARCHIVE_SUFFIX), **channels)
            answer = "ok"
        except Exception as error:  # whatever is wrong with a file, the other process is to say it
            answer = f"{type(error).__name__}: {error}".replace("\n", " ")
        answers.write(answer + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
