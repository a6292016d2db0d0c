"""Sequences of the 7-Scenes data set: a folder of ``frame-NNNNNN.{color,depth,pose}`` files.

Depth is in millimetres, 0 and 65535 invalid; poses are world_from_camera of the depth sensor. The colour camera of the
original recordings stands some 25 mm beside the depth sensor and is not registered to it; no calibration comes with
them, so colour is taken as if it were registered and is some pixels off near edges.
"""

from pathlib import Path

import numpy as np

from datagen.camera import PinholeCamera
from datagen.dataset import Dataset
from datagen.dataset_format import frame_file
from datagen.errors import InputError

METRES_PER_STEP = 0.001
INTRINSICS_FILE = "camera-intrinsics.txt"
SIZE = (640, 480)
FOCAL_LENGTH_PX = 585.0
PRINCIPAL_POINT_PX = (320.0, 240.0)


def is_seven_scenes(folder: Path) -> bool:
    """Tell whether a folder holds files named as 7-Scenes names them."""
    return any(True for _ in folder.glob("frame-[0-9]*.*"))


def open_seven_scenes(folder: Path) -> Dataset:
    """Open a sequence. Raises InputError where it has no depth images or an unreadable camera file.

    The camera is that of ``camera-intrinsics.txt`` (a 3×3 matrix) where there is one, else the data set's nominal one.
    A frame is whatever number any file carries, so that a frame that lacks its pose is reported and not passed over.
    """
    numbers = {path.name.split(".")[0].removeprefix("frame-") for path in folder.glob("frame-*.*")}
    frame_ids = tuple(sorted(int(number) for number in numbers if number.isdecimal()))
    if not any(frame_file(folder, frame_id, "depth.png").is_file() for frame_id in frame_ids):
        raise InputError(f"{folder}: no frame has a depth image (frame-NNNNNN.depth.png)")
    has_jpeg = frame_file(folder, frame_ids[0], "color.jpg").is_file()
    return Dataset(
        folder=folder,
        format_name="7-Scenes",
        frames_folder=folder,
        frame_ids=frame_ids,
        camera=_read_camera(folder / INTRINSICS_FILE),
        depth_scale=METRES_PER_STEP,
        color_suffix="jpg" if has_jpeg else "png",
    )


def _read_camera(path: Path) -> PinholeCamera:
    width, height = SIZE
    if not path.is_file():
        cx, cy = PRINCIPAL_POINT_PX
        return PinholeCamera(width=width, height=height, fx=FOCAL_LENGTH_PX, fy=FOCAL_LENGTH_PX, cx=cx, cy=cy)
    try:
        matrix = np.loadtxt(path, dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{path}: {error}; expected a 3×3 intrinsic matrix") from None
    if matrix.shape != (3, 3) or matrix[0, 1] != 0 or (matrix[2] != (0, 0, 1)).any():
        raise InputError(f"{path}: expected a 3×3 intrinsic matrix [fx 0 cx; 0 fy cy; 0 0 1], found {matrix.tolist()}")
    return PinholeCamera(width=width, height=height, fx=matrix[0, 0], fy=matrix[1, 1], cx=matrix[0, 2], cy=matrix[1, 2])
