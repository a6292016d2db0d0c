"""Recorded camera paths: TUM files, Open3D's ``.log`` files, and folders of 4×4 pose files."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.dataset import read_pose
from datagen.dataset_format import FRAMES_FOLDER
from datagen.errors import InputError
from datagen.formats.frame_numbers import frame_numbers, natural_order
from datagen.formats.open3d_log import read_log
from datagen.formats.quaternions import pose_from_quat_wxyz
from datagen.formats.text_table import read_rows

TUM_LINE = "t tx ty tz qx qy qz qw"
POSE_FILE_PATTERNS = ("*.pose.txt", f"{FRAMES_FOLDER}/*.pose.txt", "*.txt")


@dataclass(frozen=True, kw_only=True)
class Recording:
    """``world_from_camera`` (M, 4, 4), OpenCV axes, at increasing ``times`` (M,); in seconds where ``is_timed``.

    Where the file has no times they are the frames' numbers.
    """

    times: NDArray[np.float64]
    world_from_camera: NDArray[np.float64]
    is_timed: bool


def read_recording(path: Path) -> Recording:
    """Read a recorded path: a folder is one of pose files, a ``.log`` Open3D's, anything else TUM's.

    Raises InputError naming the file and line of what cannot be used.
    """
    if path.is_dir():
        return _read_pose_folder(path)
    return _read_open3d_log(path) if path.suffix == ".log" else _read_tum(path)


def locate_recording(content: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return a scene file's ``content`` with a recorded trajectory's path made absolute, and its SHA-256 set.

    ``folder`` is the scene file's. Raises InputError where the recording cannot be read, or is not the one that a
    given ``sha256`` identifies.
    """
    trajectory = content.get("trajectory")
    if not isinstance(trajectory, dict) or not isinstance(trajectory.get("file"), str):
        return content
    path = (folder / Path(trajectory["file"]).expanduser()).resolve()
    files = _pose_files(path) if path.is_dir() else [path]
    try:
        found = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be read ({error.strerror}); name a recorded path") from error
    expected = trajectory.get("sha256")
    if expected is not None and expected != found:
        raise InputError(
            f"{path}: its SHA-256 is {found}, but trajectory.sha256 says {expected}; restore it, or drop the sha256"
        )
    return content | {"trajectory": trajectory | {"file": str(path), "sha256": found}}


def _read_tum(path: Path) -> Recording:
    times: list[float] = []
    matrices = []
    for row in read_rows(path):
        row.require(8, TUM_LINE)
        time, x, y, z, qx, qy, qz, qw = row.numbers(row.fields[:8], TUM_LINE)
        if times and time <= times[-1]:
            raise row.error(f"time {time:.6f} does not come after the line before, {times[-1]:.6f}; sort the lines")
        times.append(time)
        source = f"{path}, line {row.line}"
        matrices.append(pose_from_quat_wxyz((qw, qx, qy, qz), (x, y, z), source=source))
    return _recording(path, np.array(times), matrices, is_timed=True)


def _read_open3d_log(path: Path) -> Recording:
    matrices = read_log(path)
    return _recording(path, np.arange(len(matrices), dtype=np.float64), matrices, is_timed=False)


def _pose_files(folder: Path) -> list[Path]:
    for pattern in POSE_FILE_PATTERNS:
        found = sorted(folder.glob(pattern), key=lambda path: natural_order(path.name))
        if found:
            return found
    return []


def _read_pose_folder(folder: Path) -> Recording:
    found = _pose_files(folder)
    times = np.array(frame_numbers([path.name for path in found]), dtype=np.float64)
    return _recording(folder, times, [read_pose(path) for path in found], is_timed=False)


def _recording(
    path: Path, times: NDArray[np.float64], matrices: list[NDArray[np.float64]], *, is_timed: bool
) -> Recording:
    if not matrices:
        raise InputError(
            f"{path}: holds no poses; expected lines of TUM ({TUM_LINE}), an Open3D .log, or a folder of 4×4 pose files"
        )
    return Recording(times=times, world_from_camera=np.stack(matrices), is_timed=is_timed)
