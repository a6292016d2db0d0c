"""What a dataset format is: a value that each module of this folder makes one of."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from datagen.dataset import Dataset
from datagen.rigid import Matrix

Carried = Literal["frame numbers", "timestamps", "ground-truth mesh", "recipe"]
"""What a format may have room for beyond colour, depth, poses and the camera."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OutputFrame:
    """A frame of the dataset that is being written.

    ``frame_id`` is its number in the source, ``number`` in the target; ``color`` and ``depth`` are the target's files.
    """

    frame_id: int
    number: int
    color: Path
    depth: Path
    world_from_camera: Matrix
    timestamp_s: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Conversion:
    """The dataset that is being written: where, from what, and all of its frames; ``depth_scale`` metres a step."""

    folder: Path
    source: Dataset
    frames: tuple[OutputFrame, ...]
    depth_scale: float


@dataclass(frozen=True, kw_only=True)
class DatasetFormat:
    """One format: how it is told from the others, opened, and written.

    ``detect`` takes a folder and tells whether it is one; ``open`` opens it or raises InputError. ``image_names`` gives
    the paths in the dataset of a frame's colour image, without its suffix, and of its depth image, from the frame's
    number and time (seconds). ``write_index`` writes everything but the images, which are there by then, and last of
    all the file by which ``detect`` knows the format. ``depth_scale`` is metres a step where the format fixes it.
    Colour files with other suffixes than ``color_suffixes`` become PNG. ``carries`` is what the format has room for;
    ``advice`` what a user of the written dataset should know, given the conversion.
    """

    name: str
    title: str
    detect: Callable[[Path], bool]
    open: Callable[[Path], Dataset]
    image_names: Callable[[int, float], tuple[str, str]]
    write_index: Callable[[Conversion], None]
    depth_scale: float | None = None
    color_suffixes: tuple[str, ...] = (".png", ".jpg", ".jpeg")
    carries: frozenset[Carried] = frozenset()
    advice: Callable[[Conversion], tuple[str, ...]] = lambda conversion: ()  # noqa: ARG005
