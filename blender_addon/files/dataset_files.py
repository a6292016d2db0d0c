"""A dataset of ours: its camera, its poses and its images; and the writing of one that holds a single view."""

import json
import os
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from ..errors import ReconstructionError
from .json_values import JsonValue, is_there, read_json
from .reconstruction_files import FusedFrame, Intrinsics, Pose, read_intrinsics

METADATA_FILE = "dataset.json"
_REMEDY = "choose the folder of a dataset that holds dataset.json"


@dataclass(frozen=True, kw_only=True)
class PosedFrames:
    """The frames of a dataset that have a pose, its camera, and its true mesh where it has one."""

    folder: Path
    intrinsics: Intrinsics
    frames_per_second: float
    trajectory: tuple[FusedFrame, ...]
    truth: Path | None


def read_posed_frames(folder: Path) -> PosedFrames:
    """Read a dataset's camera and poses. Raises ReconstructionError naming the file at fault."""
    folder = folder.resolve()
    metadata = read_json(folder / METADATA_FILE, remedy=_REMEDY)
    truth = metadata.optional_member("ground_truth_mesh")
    count = metadata.member("frame_count").integer(at_least=1)
    files = {i: frame_file(folder, i, "pose.txt") for i in range(count)}
    trajectory = tuple(
        FusedFrame(frame=i, world_from_camera=_read_pose(path)) for i, path in files.items() if is_there(path)
    )
    if not trajectory:
        raise ReconstructionError(f"{folder}: none of its {count} frames has a pose yet; {_REMEDY}")
    return PosedFrames(
        folder=folder,
        intrinsics=read_intrinsics(metadata.member("intrinsics")),
        frames_per_second=metadata.member("frames_per_second").positive_number(),
        trajectory=trajectory,
        truth=None if truth is None else folder / truth.text(),
    )


def frame_file(dataset: Path, frame: int, part: str) -> Path:
    """Return the path of a frame's ``color.png``, ``depth.png`` or ``pose.txt``."""
    return dataset / "frames" / f"frame-{frame:06d}.{part}"


def color_file(dataset: Path, frame: int) -> Path | None:
    """Return a frame's colour image, None where none can be seen; 7-Scenes keeps its frames in the dataset itself."""
    name = frame_file(dataset, frame, "color.png")
    return next((path for path in (name, dataset / name.name) if os.path.isfile(path)), None)


def write_single_view(
    folder: Path,
    intrinsics: Intrinsics,
    *,
    depth: Path,
    depth_scale: float,
    color: Path | None = None,
    world_from_camera: Pose | None = None,
) -> None:
    """Write a dataset of one frame, number 0, from image files: what locating takes. Raises ReconstructionError."""
    metadata = {
        "format": "scanback-dataset",
        "version": 1,
        "frame_count": 1,
        "intrinsics": asdict(intrinsics),
        "depth_scale": depth_scale,
        "frames_per_second": 1.0,
        "recipe": {},
        "provenance": {},
    }
    for image in filter(None, (depth, color)):
        if not is_there(image):
            raise ReconstructionError(f"{image}: the file is missing; choose an image")
    (folder / "frames").mkdir(parents=True)
    shutil.copyfile(depth, frame_file(folder, 0, "depth.png"))
    if color is not None:
        shutil.copyfile(color, frame_file(folder, 0, "color.png"))
    if world_from_camera is not None:
        write_pose(frame_file(folder, 0, "pose.txt"), world_from_camera)
    (folder / METADATA_FILE).write_text(json.dumps(metadata), encoding="utf-8")


def write_pose(path: Path, world_from_camera: Pose) -> None:
    """Write a 4×4 pose as text."""
    path.write_text("\n".join(" ".join(repr(float(x)) for x in row) for row in world_from_camera) + "\n")


def _read_pose(path: Path) -> Pose:
    try:
        values = np.array([float(word) for word in path.read_text().split()])
        rows = values.reshape(4, 4).tolist()
    except (OSError, ValueError) as error:
        raise ReconstructionError(f"{path}: no 4×4 pose ({error}); render the frame again") from error
    return JsonValue(path, "", rows, "render the frame again").pose()
