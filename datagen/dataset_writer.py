"""Writing the frames of a dataset."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from datagen.atomic_write import write_bytes
from datagen.dataset_format import frame_file
from datagen.images import write_color, write_depth
from datagen.layers import write_layer
from datagen.rigid import Matrix


def write_frame(
    frames_folder: Path,
    frame_id: int,
    *,
    color: NDArray[np.uint8],
    depth: NDArray[np.floating],
    world_from_camera: Matrix,
    depth_scale: float,
    layers: Mapping[str, NDArray] = MappingProxyType({}),
) -> None:
    """Write colour (H, W, 3) RGB, depth (H, W) metres and pose of a frame, each atomically and the pose last.

    ``layers`` are further images by their layer's name; they go into folders beside ``frames_folder``. A frame of
    which all files exist is whole, whatever moment its writer died at. Raises InputError where depth does not fit
    ``depth_scale`` (metres per step) or a file cannot be written.
    """
    write_color(frame_file(frames_folder, frame_id, "color.png"), color)
    write_depth(frame_file(frames_folder, frame_id, "depth.png"), depth, metres_per_step=depth_scale)
    for name, image in layers.items():
        write_layer(frames_folder.parent, name, frame_id, image, depth_scale=depth_scale)
    write_pose(frame_file(frames_folder, frame_id, "pose.txt"), world_from_camera)


def write_pose(path: Path, world_from_camera: Matrix) -> None:
    """Write a 4×4 pose atomically, with the 17 digits that bring every bit back."""
    lines = (" ".join(f"{value:.17g}" for value in row) for row in world_from_camera)
    write_bytes(path, ("\n".join(lines) + "\n").encode())
