"""Sequences of the 7-Scenes data set: a folder of ``frame-NNNNNN.{color,depth,pose}`` files.

Depth is in millimetres, 0 and 65535 invalid; poses are world_from_camera of the depth sensor. The colour camera of the
original recordings stands some 25 mm beside the depth sensor and is not registered to it; no calibration comes with
them, so colour is taken as if it were registered and is some pixels off near edges.
"""

from pathlib import Path

from datagen.camera import PinholeCamera
from datagen.dataset import Dataset, FrameRecord
from datagen.dataset_format import FRAMES_FOLDER, METADATA_FILE, frame_file
from datagen.dataset_writer import write_pose
from datagen.errors import InputError
from datagen.formats.format import Conversion, DatasetFormat
from datagen.formats.intrinsics_file import INTRINSICS_FILE, read_intrinsics, write_intrinsics
from datagen.images import image_size

METRES_PER_STEP = 0.001
SIZE = (640, 480)
FOCAL_LENGTH_PX = 585.0
PRINCIPAL_POINT_PX = (320.0, 240.0)


def detect(folder: Path) -> bool:
    """Tell whether a folder holds files named as 7-Scenes names them."""
    return any(True for _ in folder.glob("frame-[0-9]*.*"))


def open_seven_scenes(folder: Path) -> Dataset:
    """Open a sequence. Raises InputError where it has no depth images, an unreadable camera file, or is part of ours.

    The camera is that of ``camera-intrinsics.txt`` (a 3×3 matrix) where there is one, else the data set's nominal one.
    A frame is whatever number any file carries, so that a frame that lacks its pose is reported and not passed over.
    """
    if folder.name == FRAMES_FOLDER and (folder.parent / METADATA_FILE).is_file():
        raise InputError(f"{folder}: these are the frames of the dataset {folder.parent}; name that one")
    numbers = {path.name.split(".")[0].removeprefix("frame-") for path in folder.glob("frame-*.*")}
    frame_ids = sorted(int(number) for number in numbers if number.isdecimal())
    depth_images = (path for i in frame_ids if (path := frame_file(folder, i, "depth.png")).is_file())
    first_depth = next(depth_images, None)
    if first_depth is None:
        raise InputError(f"{folder}: no frame has a depth image (frame-NNNNNN.depth.png)")
    suffix = "jpg" if frame_file(folder, frame_ids[0], "color.jpg").is_file() else "png"
    return Dataset(
        folder=folder,
        format_name=FORMAT.title,
        frames={
            i: FrameRecord(
                color=frame_file(folder, i, f"color.{suffix}"),
                depth=frame_file(folder, i, "depth.png"),
                pose=frame_file(folder, i, "pose.txt"),
            )
            for i in frame_ids
        },
        camera=_camera(folder / INTRINSICS_FILE, size=image_size(first_depth)),
        depth_scale=METRES_PER_STEP,
    )


def _camera(path: Path, *, size: tuple[int, int]) -> PinholeCamera:
    if path.is_file():
        return read_intrinsics(path, size=size)
    if size != SIZE:
        raise InputError(
            f"{path}: the file is missing, and images of {size[0]}×{size[1]} are not from the camera of 7-Scenes "
            f"({SIZE[0]}×{SIZE[1]}); write the 3×3 intrinsic matrix there"
        )
    cx, cy = PRINCIPAL_POINT_PX
    return PinholeCamera(width=size[0], height=size[1], fx=FOCAL_LENGTH_PX, fy=FOCAL_LENGTH_PX, cx=cx, cy=cy)


def write_index(conversion: Conversion) -> None:
    """Write the camera and the poses."""
    write_intrinsics(conversion.folder / INTRINSICS_FILE, conversion.source.camera)
    for frame in conversion.frames:
        write_pose(frame_file(conversion.folder, frame.number, "pose.txt"), frame.world_from_camera)


FORMAT = DatasetFormat(
    name="7scenes",
    title="7-Scenes",
    detect=detect,
    open=open_seven_scenes,
    image_names=lambda number, _: (f"frame-{number:06d}.color", f"frame-{number:06d}.depth.png"),
    write_index=write_index,
    depth_scale=METRES_PER_STEP,
    color_suffixes=(".png",),
    carries=frozenset({"frame numbers"}),
)
