"""An open dataset: posed RGB-D frames, whatever folder format they came in."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.dataset_format import Metadata
from datagen.errors import InputError
from datagen.images import read_color, read_depth, read_depth_steps
from datagen.layers import LAYERS, layer_file
from datagen.rigid import Matrix, rigid

Part = Literal["color", "depth", "pose"]
COLOR_PART: Part = "color"
DEPTH_PART: Part = "depth"
POSE_PART: Part = "pose"
PARTS: tuple[Part, ...] = (COLOR_PART, DEPTH_PART, POSE_PART)
"""What makes a frame whole."""

DEPTH_LAYERS = ("sensor_depth",)
"""Layers that can stand for depth."""


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


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameRecord:
    """Where the parts of one frame are.

    ``pose`` is a file with a 4×4 world_from_camera, or the matrix itself where the format keeps all poses in one table,
    or None where the frame has none. ``timestamp_s`` is seconds, None where the format knows no time.
    """

    color: Path
    depth: Path
    pose: Path | Matrix | None
    timestamp_s: float | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Dataset:
    """Posed RGB-D frames in a folder; images are read when asked for, and every read is checked.

    ``frames`` are those that the dataset says it has, in order, whether or not all of their files are there yet.
    ``depth_scale`` is metres per step of the depth images. ``layers`` names the further images that each frame has.
    ``metadata`` is None where the format has none. ``notes`` say what a user of the data should know about them.
    """

    folder: Path
    format_name: str
    frames: Mapping[int, FrameRecord]
    camera: PinholeCamera
    depth_scale: float
    layers: tuple[str, ...] = ()
    ground_truth_mesh: Path | None = None
    metadata: Metadata | None = None
    notes: tuple[str, ...] = ()

    @cached_property
    def frame_ids(self) -> tuple[int, ...]:
        """The numbers of the frames, in order."""
        return tuple(self.frames)

    @property
    def _size(self) -> tuple[int, int]:
        return self.camera.width, self.camera.height

    def record(self, frame_id: int) -> FrameRecord:
        """Return where a frame's parts are; raises InputError where the dataset has no such frame."""
        try:
            return self.frames[frame_id]
        except KeyError:
            span = f"{self.frame_ids[0]} to {self.frame_ids[-1]}" if self.frame_ids else "none"
            raise InputError(f"{self.folder}: has no frame {frame_id}; its frames are {span}") from None

    def color(self, frame_id: int) -> NDArray[np.uint8]:
        """Return the colour image (height, width, 3), RGB, of a frame."""
        return read_color(self.color_file(frame_id), size=self._size)

    def depth(self, frame_id: int) -> NDArray[np.float32]:
        """Return planar depth (height, width) in metres, 0 = invalid, of a frame."""
        return read_depth(self.depth_file(frame_id), size=self._size, metres_per_step=self.depth_scale)

    def depth_steps(self, frame_id: int) -> NDArray[np.uint16]:
        """Return planar depth (height, width) in steps of ``depth_scale`` metres, 0 = invalid, of a frame."""
        return read_depth_steps(self.depth_file(frame_id), size=self._size)

    def color_file(self, frame_id: int) -> Path:
        """Return the file of a frame's colour image."""
        return self.record(frame_id).color

    def depth_file(self, frame_id: int) -> Path:
        """Return the file of a frame's depth image."""
        return self.record(frame_id).depth

    def world_from_camera(self, frame_id: int) -> Matrix:
        """Return the pose of a frame, made exactly rigid where it is so within rounding."""
        pose = self.record(frame_id).pose
        if pose is None:
            raise InputError(self._lack(frame_id, POSE_PART))
        return read_pose(pose) if isinstance(pose, Path) else pose.copy()

    def timestamp_s(self, frame_id: int) -> float | None:
        """Return when a frame was taken, in seconds, or None where the format does not say."""
        return self.record(frame_id).timestamp_s

    def layer_file(self, name: str, frame_id: int) -> Path:
        """Return the file of a frame's image in the layer ``name``; raises InputError where the dataset has none."""
        if name not in self.layers or name not in LAYERS:
            there = ", ".join(self.layers) or "none"
            raise InputError(f"{self.folder}: has no layer {name!r}; its layers are: {there}")
        return layer_file(self.folder, name, frame_id)

    def read_layer(self, name: str, frame_id: int) -> NDArray:
        """Return a frame's image in the layer ``name``: its array as ``datagen.layers`` says, depth in metres."""
        path, layer = self.layer_file(name, frame_id), LAYERS[name]
        if layer.decode is not None:
            return layer.decode(path)
        if layer.part == "depth.png":
            return read_depth(path, size=self._size, metres_per_step=self.depth_scale)
        return read_color(path, size=self._size)

    def with_depth_layer(self, name: str) -> "Dataset":
        """Return the dataset with a layer in the place of depth, as the frames' camera sees it: ``sensor_depth``.

        Raises InputError where the dataset does not have it, and for what is not depth from the frames' own camera.
        """
        if name not in DEPTH_LAYERS:
            raise InputError(f"{name}: not depth that the frames' own camera sees; there is {', '.join(DEPTH_LAYERS)}")
        frames = {i: replace(record, depth=self.layer_file(name, i)) for i, record in self.frames.items()}
        return replace(self, frames=frames)

    def frame(self, frame_id: int) -> Frame:
        """Read a whole frame."""
        return Frame(
            frame_id=frame_id,
            color=self.color(frame_id),
            depth=self.depth(frame_id),
            world_from_camera=self.world_from_camera(frame_id),
        )

    def is_complete(self, frame_id: int) -> bool:
        """Tell whether colour, depth and pose of a frame are there."""
        return all(self.has(frame_id, part) for part in PARTS)

    def has(self, frame_id: int, part: Part) -> bool:
        """Tell whether one part of a frame is there."""
        place = self._place(frame_id, part)
        return place.is_file() if isinstance(place, Path) else place is not None

    def require(self, frame_ids: tuple[int, ...], parts: tuple[Part, ...] = PARTS) -> None:
        """Raise InputError, naming the first file that is missing, unless ``parts`` of each frame are there."""
        missing = [(i, part) for i in frame_ids for part in parts if not self.has(i, part)]
        if missing:
            raise InputError(
                f"{self._lack(*missing[0])}, and {len(dict(missing))} of the {len(frame_ids)} chosen frames lack "
                "one; finish the recording or rendering, or choose complete frames with --frames"
            )

    def _place(self, frame_id: int, part: Part) -> Path | Matrix | None:
        record = self.record(frame_id)
        return {COLOR_PART: record.color, DEPTH_PART: record.depth, POSE_PART: record.pose}[part]

    def _lack(self, frame_id: int, part: Part) -> str:
        place = self._place(frame_id, part)
        if isinstance(place, Path):
            return f"{place}: the file is missing"
        return f"{self.folder}: frame {frame_id} has no {part}"


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
