"""How far the scan in a folder is, looked up at most once a second: panels are drawn much more often."""

import json
import os
import time
from dataclasses import dataclass
from pathlib import Path

from ..scan_folder import DATASET, RECONSTRUCTION

KEEP_SECONDS = 1.0
POSE_SUFFIX = ".pose.txt"


@dataclass(frozen=True, kw_only=True)
class Status:
    """What is there: ``frames`` of ``frame_count`` (None: no dataset), a reconstruction, the dataset's true mesh.

    ``is_there`` tells whether the dataset's folder is, with whatever it holds.
    """

    is_there: bool
    frames: int
    frame_count: int | None
    is_fused: bool
    has_truth: bool
    has_sensor: bool

    @property
    def is_scanned(self) -> bool:
        """Tell whether all frames are there."""
        return self.frame_count is not None and self.frames >= self.frame_count


NOTHING = Status(is_there=False, frames=0, frame_count=None, is_fused=False, has_truth=False, has_sensor=False)
_known: dict[tuple[Path, Path], tuple[float, Status]] = {}


def status_of(folder: Path, dataset: Path | None = None) -> Status:
    """Return the status of a scan's folder, with another ``dataset`` than its own where given."""
    dataset = dataset or folder / DATASET
    key, now = (folder, dataset), time.monotonic()
    if key not in _known or now - _known[key][0] > KEEP_SECONDS:
        if len(_known) > 20:
            _known.clear()
        try:
            found = _look_up(folder, dataset)
        except OSError:  # a folder that nobody may look into
            found = NOTHING
        _known[key] = (now, found)
    return _known[key][1]


def forget() -> None:
    """Look everything up anew: something was written."""
    _known.clear()


def _look_up(folder: Path, dataset: Path) -> Status:
    metadata = _metadata(dataset / "dataset.json")
    count = metadata.get("frame_count")
    is_foreign = not metadata and dataset.is_dir() and any(dataset.iterdir())
    if is_foreign:  # of another format: fusion tells what is wrong with it
        count = 0
    truth = metadata.get("ground_truth_mesh")
    layers = metadata.get("layers")
    return Status(
        is_there=dataset.exists(),
        frames=_frames(dataset / "frames"),
        frame_count=count if isinstance(count, int) else None,
        is_fused=(folder / RECONSTRUCTION / "reconstruction.json").is_file(),
        has_truth=isinstance(truth, str) and (dataset / truth).is_file(),
        has_sensor=isinstance(layers, list) and "sensor_depth" in layers,
    )


def _metadata(path: Path) -> dict[str, object]:
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _frames(folder: Path) -> int:
    try:
        with os.scandir(folder) as entries:
            return sum(entry.name.endswith(POSE_SUFFIX) and not entry.name.startswith(".") for entry in entries)
    except OSError:
        return 0
