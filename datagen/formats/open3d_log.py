"""Open3D's reconstruction system: ``color``, ``depth``, a camera as JSON, and the poses in a ``.log`` file.

The log has five lines a frame: three integers, and the 4×4 world_from_camera; its entries belong to the images in the
order of their names. ``config.json`` has ``depth_scale``, here steps a metre.
"""

from pathlib import Path
from typing import Any

import numpy as np

from datagen.atomic_write import write_bytes, write_json
from datagen.camera import PinholeCamera
from datagen.dataset import Dataset, FrameRecord
from datagen.errors import InputError
from datagen.formats.format import Conversion, DatasetFormat
from datagen.formats.frame_numbers import frame_numbers, natural_order
from datagen.formats.intrinsics_file import camera_from_matrix
from datagen.formats.json_file import LARGEST_DEPTH_SCALE_M, numbers, read_json_object
from datagen.formats.text_table import Row, read_rows
from datagen.images import DEPTH_INVALID_MAX
from datagen.rigid import Matrix, rigid

TRAJECTORY_FILE = "scene/trajectory.log"
INTRINSIC_FILE = "camera_intrinsic.json"
CONFIG_FILE = "config.json"
COLOR_FOLDERS = ("color", "rgb", "image")
COLOR_SUFFIXES = (".png", ".jpg")
DEFAULT_STEPS_PER_METRE = 1000.0
MOST_STEPS_PER_METRE = 1e9
ROWS_PER_POSE = 5


def detect(folder: Path) -> bool:
    """Tell whether a folder holds depth images and a trajectory as Open3D writes them."""
    return (folder / "depth").is_dir() and bool(_trajectories(folder))


def _trajectories(folder: Path) -> list[Path]:
    standard = folder / TRAJECTORY_FILE
    return [standard] if standard.is_file() else sorted(folder.glob("*.log"))


def open_open3d_log(folder: Path) -> Dataset:
    """Open a recording. Raises InputError, naming file and line, for malformed poses, and where counts do not match."""
    trajectories = _trajectories(folder)
    if len(trajectories) > 1:
        raise InputError(f"{folder}: holds {len(trajectories)} .log files; name the trajectory {TRAJECTORY_FILE}")
    poses = read_log(trajectories[0])
    color_folder = next((folder / name for name in COLOR_FOLDERS if (folder / name).is_dir()), folder / "color")
    colors, depths = _images(color_folder, COLOR_SUFFIXES), _images(folder / "depth", (".png",))
    for place, images in ((color_folder, colors), (folder / "depth", depths)):
        if len(images) != len(poses):
            raise InputError(
                f"{place}: holds {len(images)} images, {trajectories[0]} {len(poses)} poses; expected as many, as they "
                "belong together by their order"
            )
    frames = (FrameRecord(color=c, depth=d, pose=pose) for c, d, pose in zip(colors, depths, poses, strict=True))
    config = folder / CONFIG_FILE
    key = "depth_scale"
    steps = (read_json_object(config) if config.is_file() else {}).get(key, DEFAULT_STEPS_PER_METRE)
    steps_per_metre = float(numbers(steps, 1, source=f"{config}: {key}")[0])
    if not 1 / LARGEST_DEPTH_SCALE_M <= steps_per_metre <= MOST_STEPS_PER_METRE:
        raise InputError(f"{config}: {key}: found {steps_per_metre:g}, expected 0.1 to 1e9 steps a metre")
    return Dataset(
        folder=folder,
        format_name=FORMAT.title,
        frames=dict(zip(frame_numbers([path.name for path in depths]), frames, strict=True)),
        camera=_camera(folder),
        depth_scale=1 / steps_per_metre,
        notes=() if config.is_file() else (f"depth: {1 / steps_per_metre:g} m a step, Open3D's default",),
    )


def read_log(path: Path) -> list[Matrix]:
    """Return the poses, world_from_camera, of a trajectory; raises InputError naming the line at fault."""
    rows = read_rows(path)
    if not rows:
        raise InputError(f"{path}: holds no pose")
    return [_pose(rows[i : i + ROWS_PER_POSE]) for i in range(0, len(rows), ROWS_PER_POSE)]


def _pose(rows: list[Row]) -> Matrix:
    head = rows[0]
    if len(head.fields) != 3:
        raise head.error(f"found {len(head.fields)} fields, expected the three integers before each pose")
    if len(rows) < ROWS_PER_POSE:
        raise rows[-1].error("the file ends within a pose; each has a line of three integers and four of a 4×4 matrix")
    expected = "a row of a 4×4 world_from_camera matrix"
    for row in rows[1:]:
        if len(row.fields) != 4:
            raise row.error(f"found {len(row.fields)} fields, expected {expected}")
    matrix = np.stack([row.numbers(row.fields, expected) for row in rows[1:]])
    return rigid(matrix, source=f"{head.path}, line {head.line}")


def _images(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    return sorted((path for path in folder.glob("*") if path.suffix in suffixes), key=lambda p: natural_order(p.name))


def _camera(folder: Path) -> PinholeCamera:
    """Return the camera of the JSON file that ``config.json`` names, or of ``camera_intrinsic.json``."""
    config = folder / CONFIG_FILE
    named = read_json_object(config).get("path_intrinsic") if config.is_file() else None
    path = folder / named if isinstance(named, str) and named else folder / INTRINSIC_FILE
    path = path if path.is_file() else folder / INTRINSIC_FILE
    if not path.is_file():
        raise InputError(
            f"{path}: the file is missing; write Open3D's camera there, with width, height and intrinsic_matrix"
        )
    content: dict[str, Any] = read_json_object(path)
    matrix = numbers(content.get("intrinsic_matrix"), 9, source=f"{path}: intrinsic_matrix")
    width, height = numbers([content.get("width"), content.get("height")], 2, source=f"{path}: width, height")
    if (width, height) != (int(width), int(height)):
        raise InputError(f"{path}: width, height: found {width:g}, {height:g}, expected integers")
    # Open3D stores matrices column by column.
    return camera_from_matrix(matrix.reshape(3, 3).T, size=(int(width), int(height)), source=str(path))


def write_index(conversion: Conversion) -> None:
    """Write the camera, the configuration and the trajectory."""
    camera = conversion.source.camera
    intrinsic = {
        "width": camera.width,
        "height": camera.height,
        "intrinsic_matrix": [camera.fx, 0.0, 0.0, 0.0, camera.fy, 0.0, camera.cx, camera.cy, 1.0],
    }
    config = {
        "name": "converted by scanback",
        "path_dataset": ".",
        "path_intrinsic": INTRINSIC_FILE,
        "depth_scale": _steps_per_metre(conversion),
        "depth_max": conversion.depth_scale * (DEPTH_INVALID_MAX - 1),
    }
    lines = []
    for i, frame in enumerate(conversion.frames):
        lines.append(f"{i} {i} {i + 1}")
        lines += [" ".join(repr(float(value)) for value in row) for row in frame.world_from_camera]
    write_json(conversion.folder / INTRINSIC_FILE, intrinsic)
    write_json(conversion.folder / CONFIG_FILE, config)
    write_bytes(conversion.folder / TRAJECTORY_FILE, ("\n".join(lines) + "\n").encode())


def _steps_per_metre(conversion: Conversion) -> float:
    """Return the reciprocal of the depth scale, without the rounding error where it is a whole number."""
    steps = 1 / conversion.depth_scale
    return float(round(steps)) if abs(steps - round(steps)) <= 1e-9 * steps else steps


FORMAT = DatasetFormat(
    name="open3d",
    title="Open3D",
    detect=detect,
    open=open_open3d_log,
    image_names=lambda number, _: (f"color/{number:06d}", f"depth/{number:06d}.png"),
    write_index=write_index,
    color_suffixes=COLOR_SUFFIXES,
    carries=frozenset({"frame numbers"}),
    advice=lambda _: (f"Open3D takes paths in {CONFIG_FILE} from where it runs: run it in the dataset's folder",),
)
