"""TUM RGB-D: lists of timestamped images, and of the poses that a motion capture system measured at other times.

``rgb.txt`` and ``depth.txt`` have ``timestamp file``; ``groundtruth.txt`` has ``timestamp tx ty tz qx qy qz qw``, which
is world_from_camera. Depth images have 5000 steps a metre. The format has no place for intrinsics.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.atomic_write import write_bytes
from datagen.camera import PinholeCamera
from datagen.dataset import Dataset, FrameRecord
from datagen.errors import InputError
from datagen.formats.format import Conversion, DatasetFormat
from datagen.formats.intrinsics_file import INTRINSICS_FILE, read_intrinsics, write_intrinsics
from datagen.formats.quaternions import pose_from_quat_wxyz, quat_wxyz_from_rotation
from datagen.formats.text_table import read_rows
from datagen.images import image_size
from datagen.rigid import Matrix

COLOR_LIST, DEPTH_LIST, POSE_LIST = "rgb.txt", "depth.txt", "groundtruth.txt"
METRES_PER_STEP = 1 / 5000
LARGEST_TIME_DIFFERENCE_S = 0.02
POSE_COLUMNS = "timestamp tx ty tz qx qy qz qw"

CALIBRATIONS = {
    "freiburg1": (517.306408, 516.469215, 318.643040, 255.313989),
    "freiburg2": (520.908620, 521.007327, 325.141442, 249.701764),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
"""fx, fy, cx, cy of the colour cameras of the published recordings, 640×480, by what their folders' names contain."""
CALIBRATED_SIZE = (640, 480)
CALIBRATION_NOTES = {
    "freiburg1": "lens distortion of this camera is not corrected: straight edges bend by some pixels at the corners",
    "freiburg2": "lens distortion of this camera is not corrected; and its depth is known to be some 4 % off",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class _Timed:
    """A list's times (seconds, rising) and what stands at each."""

    times: NDArray[np.float64]
    values: list


def detect(folder: Path) -> bool:
    """Tell whether a folder holds TUM's lists of images."""
    return (folder / COLOR_LIST).is_file() and (folder / DEPTH_LIST).is_file()


def open_tum_rgbd(folder: Path) -> Dataset:
    """Open a recording: images and poses belong together where they are nearest in time and at most 0.02 s apart.

    A frame has the time and pose of its depth image. Images without a partner are left out, as TUM's own tools do;
    where there is no ``groundtruth.txt``, frames have no poses. Raises InputError, naming file and line, for a
    malformed list, and where the camera is not known.
    """
    colors, depths = _read_list(folder / COLOR_LIST), _read_list(folder / DEPTH_LIST)
    pairs = associate(colors.times, depths.times)
    if not pairs:
        raise InputError(
            f"{folder / DEPTH_LIST}: no depth image within {LARGEST_TIME_DIFFERENCE_S} s of any image of {COLOR_LIST}"
        )
    poses = _read_poses(folder / POSE_LIST) if (folder / POSE_LIST).is_file() else None
    frames = [
        FrameRecord(color=colors.values[i], depth=depths.values[j], pose=pose, timestamp_s=float(depths.times[j]))
        for i, j in pairs
        if (pose := _nearest_pose(poses, float(depths.times[j]))) is not None or poses is None
    ]
    if not frames:
        raise InputError(
            f"{folder / POSE_LIST}: no pose within {LARGEST_TIME_DIFFERENCE_S} s of any depth image; "
            f"the images are from {depths.times[0]:.3f} to {depths.times[-1]:.3f} s"
        )
    camera, notes = _camera(folder, size=image_size(frames[0].depth))
    left_out = len(colors.times) - len(frames)
    if left_out:
        reason = f"no depth image or pose within {LARGEST_TIME_DIFFERENCE_S} s"
        notes = (*notes, f"{left_out} of {len(colors.times)} colour images are left out: {reason}")
    return Dataset(
        folder=folder,
        format_name=FORMAT.title,
        frames=dict(enumerate(frames)),
        camera=camera,
        depth_scale=METRES_PER_STEP,
        notes=notes,
    )


def associate(first_s: NDArray[np.float64], second_s: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return pairs of positions in two rising lists of times, each in one pair at most, the closest served first.

    Times of a pair are at most ``LARGEST_TIME_DIFFERENCE_S`` apart. The pairs come in order of time.
    """
    # Times since the epoch have steps of 2.4e-7 s: a difference of exactly the limit may come out above it.
    limit = LARGEST_TIME_DIFFERENCE_S + 1e-6
    low = np.searchsorted(second_s, first_s - limit)
    high = np.searchsorted(second_s, first_s + limit, side="right")
    near = [(i, j) for i in range(len(first_s)) for j in range(low[i], high[i])]
    near.sort(key=lambda pair: abs(first_s[pair[0]] - second_s[pair[1]]))
    free_first, free_second, pairs = set(range(len(first_s))), set(range(len(second_s))), []
    for i, j in near:
        if i in free_first and j in free_second:
            free_first.remove(i)
            free_second.remove(j)
            pairs.append((i, j))
    return sorted(pairs)


def _nearest_pose(poses: _Timed | None, time_s: float) -> Matrix | None:
    if poses is None or len(poses.times) == 0:
        return None
    nearest = int(np.argmin(np.abs(poses.times - time_s)))
    close = abs(poses.times[nearest] - time_s) <= LARGEST_TIME_DIFFERENCE_S + 1e-6
    return poses.values[nearest] if close else None


def _read_list(path: Path) -> _Timed:
    times, files = [], []
    for row in read_rows(path):
        row.require(2, "timestamp file")
        times.append(row.numbers(row.fields[:1], "timestamp file")[0])
        files.append(path.parent / " ".join(row.fields[1:]))
    if not times:
        raise InputError(f"{path}: lists no image; each line reads: timestamp file")
    return _in_order(times, files)


def _read_poses(path: Path) -> _Timed:
    times, poses = [], []
    for row in read_rows(path):
        row.require(8, POSE_COLUMNS)
        time, x, y, z, qx, qy, qz, qw = row.numbers(row.fields[:8], POSE_COLUMNS)
        times.append(time)
        poses.append(pose_from_quat_wxyz((qw, qx, qy, qz), (x, y, z), source=f"{path}, line {row.line}"))
    return _in_order(times, poses)


def _in_order(times: Sequence[float], values: list) -> _Timed:
    order = np.argsort(times, kind="stable")
    return _Timed(times=np.array(times, dtype=np.float64)[order], values=[values[i] for i in order])


def _camera(folder: Path, *, size: tuple[int, int]) -> tuple[PinholeCamera, tuple[str, ...]]:
    """Return the camera of the intrinsics file or of the published calibration, and what to know about it."""
    path = folder / INTRINSICS_FILE
    if path.is_file():
        return read_intrinsics(path, size=size), ()
    known = next((name for name in CALIBRATIONS if name in folder.resolve().name), None)
    if known is None or size != CALIBRATED_SIZE:
        raise InputError(
            f"{path}: the file is missing, and TUM RGB-D has no other place for the camera; write the 3×3 intrinsic "
            "matrix there (three lines: fx 0 cx, 0 fy cy, 0 0 1), or keep freiburg1, freiburg2 or freiburg3 in the "
            "folder's name for 640×480 images of the published recordings"
        )
    fx, fy, cx, cy = CALIBRATIONS[known]
    notes: tuple[str, ...] = (f"camera: the published calibration of {known}",)
    if known in CALIBRATION_NOTES:
        notes = (*notes, CALIBRATION_NOTES[known])
    return PinholeCamera(width=size[0], height=size[1], fx=fx, fy=fy, cx=cx, cy=cy), notes


def write_index(conversion: Conversion) -> None:
    """Write the camera, the poses and the two lists of images."""
    folder = conversion.folder
    poses, colors, depths = [], [], []
    for frame in conversion.frames:
        time = repr(frame.timestamp_s)
        w, x, y, z = quat_wxyz_from_rotation(frame.world_from_camera[:3, :3])
        numbers = (*frame.world_from_camera[:3, 3], x, y, z, w)
        poses.append(" ".join([time, *(repr(float(number)) for number in numbers)]))
        colors.append(f"{time} {frame.color.relative_to(folder).as_posix()}")
        depths.append(f"{time} {frame.depth.relative_to(folder).as_posix()}")
    write_intrinsics(folder / INTRINSICS_FILE, conversion.source.camera)
    _write_lines(folder / POSE_LIST, POSE_COLUMNS, poses)
    _write_lines(folder / DEPTH_LIST, "timestamp filename", depths)
    _write_lines(folder / COLOR_LIST, "timestamp filename", colors)


def _write_lines(path: Path, columns: str, lines: list[str]) -> None:
    write_bytes(path, "".join(f"{line}\n" for line in (f"# {columns}", *lines)).encode())


FORMAT = DatasetFormat(
    name="tum",
    title="TUM RGB-D",
    detect=detect,
    open=open_tum_rgbd,
    image_names=lambda _, timestamp_s: (f"rgb/{timestamp_s:.6f}", f"depth/{timestamp_s:.6f}.png"),
    write_index=write_index,
    depth_scale=METRES_PER_STEP,
    carries=frozenset({"timestamps"}),
    advice=lambda _: (f"the format has no place for the camera: it is in {INTRINSICS_FILE}",),
)
