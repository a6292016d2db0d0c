"""An open dataset: posed RGB-D frames, whatever folder format they came in."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.dataset_format import Metadata, frame_file
from datagen.errors import InputError
from datagen.images import read_color, read_depth, read_depth_steps
from datagen.rigid import Matrix, rigid

DEPTH_PART = "depth.png"
POSE_PART = "pose.txt"


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One posed RGB-D image.

    ``color`` (height, width, 3) uint8 RGB; ``depth`` (height, width) float32, planar, metres, 0 = invalid;
    ``world_from_camera`` 4×4 rigid, OpenCV camera axes.
    """

    frame_id: int
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    world_from_camera: Matrix


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Posed RGB-D frames in a folder; images are read when asked for, and every read is checked.

    ``frame_ids`` are the frames that the dataset says it has, whether or not all of their files are there yet.
    ``depth_scale`` is metres per step of the depth images. ``metadata`` is None where the format has none.
    """

    folder: Path
    format_name: str
    frames_folder: Path
    frame_ids: tuple[int, ...]
    camera: PinholeCamera
    depth_scale: float
    color_suffix: str = "png"
    ground_truth_mesh: Path | None = None
    metadata: Metadata | None = None

    @property
    def _size(self) -> tuple[int, int]:
        return self.camera.width, self.camera.height

    def color(self, frame_id: int) -> NDArray[np.uint8]:
        """Return the colour image (height, width, 3), RGB, of a frame."""
        return read_color(frame_file(self.frames_folder, frame_id, f"color.{self.color_suffix}"), size=self._size)

    def depth(self, frame_id: int) -> NDArray[np.float32]:
        """Return planar depth (height, width) in metres, 0 = invalid, of a frame."""
        return read_depth(self.depth_file(frame_id), size=self._size, metres_per_step=self.depth_scale)

    def depth_steps(self, frame_id: int) -> NDArray[np.uint16]:
        """Return planar depth (height, width) in steps of ``depth_scale`` metres, 0 = invalid, of a frame."""
        return read_depth_steps(self.depth_file(frame_id), size=self._size)

    def depth_file(self, frame_id: int) -> Path:
        """Return the file of a frame's depth image."""
        return frame_file(self.frames_folder, frame_id, DEPTH_PART)

    def world_from_camera(self, frame_id: int) -> Matrix:
        """Return the pose of a frame, made exactly rigid where it is so within rounding."""
        return read_pose(frame_file(self.frames_folder, frame_id, POSE_PART))

    def frame(self, frame_id: int) -> Frame:
        """Read a whole frame."""
        return Frame(
            frame_id=frame_id,
            color=self.color(frame_id),
            depth=self.depth(frame_id),
            world_from_camera=self.world_from_camera(frame_id),
        )

    @property
    def parts(self) -> tuple[str, ...]:
        """The files that make a frame, by their names' ends."""
        return (f"color.{self.color_suffix}", DEPTH_PART, POSE_PART)

    def is_complete(self, frame_id: int) -> bool:
        """Tell whether all files of a frame are there."""
        return all(self.has(frame_id, part) for part in self.parts)

    def has(self, frame_id: int, part: str) -> bool:
        """Tell whether one file of a frame is there."""
        return frame_file(self.frames_folder, frame_id, part).is_file()

    def require(self, frame_ids: tuple[int, ...], parts: tuple[str, ...] | None = None) -> None:
        """Raise InputError, naming the first file that is missing, unless ``parts`` (all) of each frame are there."""
        parts = parts or self.parts
        missing = [(i, part) for i in frame_ids for part in parts if not self.has(i, part)]
        if missing:
            first = frame_file(self.frames_folder, *missing[0])
            raise InputError(
                f"{first}: the file is missing, and {len(dict(missing))} of the {len(frame_ids)} chosen frames lack "
                "one; finish the recording or rendering, or choose complete frames with --frames"
            )


def read_pose(path: Path) -> Matrix:
    """Read a 4×4 pose from a text file; raises InputError where it is missing, malformed or not rigid."""
    try:
        text = path.read_text()
    except FileNotFoundError:
        raise InputError(f"{path}: the file is missing; every frame needs its pose") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from error
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError as error:
        raise InputError(f"{path}: {error}; expected 16 numbers, a 4×4 world_from_camera matrix") from None
    if values.size != 16:
        raise InputError(f"{path}: found {values.size} numbers, expected 16, a 4×4 world_from_camera matrix")
    return rigid(values.reshape(4, 4), source=str(path))
