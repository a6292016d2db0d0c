"""Which dataset is fused."""

from pathlib import Path
from typing import Any

import bpy

from ..scan_folder import DATASET


def dataset_of(scene: Any, folder: Path, given: str = "") -> Path:
    """Return the dataset that is fused: as given, as set in the panel, or the one scanned into ``folder``."""
    named = given or scene.scanback.fuse.dataset
    return Path(bpy.path.abspath(named)).resolve() if named else folder / DATASET
