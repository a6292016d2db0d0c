"""Model files checked for vertices that are no numbers, which Blender's importers take for zeros without a word."""

import re
from pathlib import Path

import numpy as np
import trimesh

from datagen.errors import InputError

OBJ_VERTEX_WITHOUT_NUMBER = re.compile(rb"^v[ \t][^#\n]*?(?:nan|inf)", re.IGNORECASE | re.MULTILINE)


def require_finite(path: Path) -> None:
    """Raise InputError where a vertex of an OBJ, PLY or STL file is no finite number; of other formats say nothing.

    What cannot be read at all is left to Blender to complain of.
    """
    kind = path.suffix.lower()
    if kind == ".obj":
        finite = OBJ_VERTEX_WITHOUT_NUMBER.search(path.read_bytes()) is None
    elif kind in (".ply", ".stl"):
        try:
            model = trimesh.load(path, process=False)
        except Exception:  # its parsers raise whatever they stumble over
            return
        finite = bool(np.isfinite(getattr(model, "vertices", 0.0)).all())
    else:
        return
    if not finite:
        raise InputError(f"{path}: has vertices that are not finite numbers; repair it and export anew")
