"""A frame of the scan beside the reconstruction, seen from the same place."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from blender_addon.reconstruction_files import Reconstruction
from datagen.dataset import Dataset, open_dataset
from datagen.errors import InputError
from datagen.images import write_color
from datagen.rigid import Matrix

BACKGROUND = 245
INK = 40
GAP_PX = 8
CAPTION_WIDTH_PX = 480


@dataclass(frozen=True, kw_only=True)
class Original:
    """The frame to compare with: its colour (height, width, 3) uint8 RGB, its pose, and what to write below it."""

    frame: int
    caption: str
    color: NDArray[np.uint8]
    world_from_camera: Matrix


def choose_original(reconstruction: Reconstruction) -> Original:
    """Return the located frame with the least score, or, where none was located, the first fused frame.

    Raises InputError where the dataset is not there or its images are not the reconstruction's.
    """
    dataset = open_dataset(reconstruction.dataset)
    camera = reconstruction.intrinsics
    if (dataset.camera.width, dataset.camera.height) != (camera.width, camera.height):
        raise InputError(
            f"{dataset.folder}: its images are {dataset.camera.width}×{dataset.camera.height}, "
            f"the reconstruction was made from {camera.width}×{camera.height}; name its own dataset"
        )
    by_score = sorted(reconstruction.located, key=lambda located: located.score)
    located = [frame.query for frame in by_score if dataset.is_complete(frame.query)]
    if located:
        is_fused = any(fused.frame == located[0] for fused in reconstruction.trajectory)
        return _original(dataset, located[0], f"frame {located[0]}" + ("" if is_fused else ", held out of the fusion"))
    if not reconstruction.trajectory:
        raise InputError(f"{reconstruction.folder}: holds neither fused nor located frames to compare with")
    frame = reconstruction.trajectory[0].frame
    return _original(dataset, frame, f"frame {frame}")


def _original(dataset: Dataset, frame: int, caption: str) -> Original:
    return Original(
        frame=frame,
        caption=caption,
        color=dataset.color(frame),
        world_from_camera=dataset.world_from_camera(frame),
    )


def write_side_by_side(path: Path, *, original: Original, rendered: NDArray[np.uint8]) -> None:
    """Write the original (left) and the render of the reconstruction (right), equal in size, with captions, as PNG."""
    factor = max(1, CAPTION_WIDTH_PX // original.color.shape[1])  # small pictures grow until the captions fit
    left, right = (picture.repeat(factor, axis=0).repeat(factor, axis=1) for picture in (original.color, rendered))
    gap = np.full((left.shape[0], GAP_PX, 3), BACKGROUND, dtype=np.uint8)
    pictures = np.hstack([left, gap, right])
    scale = min(1.0, left.shape[1] / 640)
    strip = np.full((round(40 * scale), pictures.shape[1], 3), BACKGROUND, dtype=np.uint8)
    captions = ((0, f"scan: {original.caption}"), (left.shape[1] + GAP_PX, "reconstruction, same camera"))
    for start, text in captions:
        place = (start + round(10 * scale), round(27 * scale))
        cv2.putText(strip, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.65 * scale, (INK,) * 3, 1, cv2.LINE_AA)
    write_color(path, np.vstack([pictures, strip]))
