"""A frame of the scan beside the reconstruction, seen from the same place."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from blender_addon.files.reconstruction_files import Reconstruction
from blender_addon.headless.overview_camera import overview_direction
from datagen.errors import InputError
from datagen.images import write_color
from datagen.open_dataset import open_dataset
from datagen.rigid import Matrix

BACKGROUND = 245
INK = 40
GAP_PX = 8
CAPTION_WIDTH_PX = 480


@dataclass(frozen=True, kw_only=True)
class Original:
    """The frame to compare with: its colour (height, width, 3) uint8 RGB, its pose, and what to write below it."""

    caption: str
    color: NDArray[np.uint8]
    world_from_camera: Matrix


def choose_original(reconstruction: Reconstruction) -> Original:
    """Return a located frame or, where none was located, a fused one: that which looks most as the overview does.

    Raises InputError where the dataset is not there or its images are not the reconstruction's.
    """
    dataset = open_dataset(reconstruction.dataset)
    camera = reconstruction.intrinsics
    if (dataset.camera.width, dataset.camera.height) != (camera.width, camera.height):
        raise InputError(
            f"{dataset.folder}: its images are {dataset.camera.width}×{dataset.camera.height}, "
            f"the reconstruction was made from {camera.width}×{camera.height}; name its own dataset"
        )
    fused = {frame.frame: frame.world_from_camera for frame in reconstruction.trajectory}
    queries = {located.query for located in reconstruction.located} & set(dataset.frame_ids)
    located = {query: dataset.world_from_camera(query) for query in sorted(queries) if dataset.is_complete(query)}
    if not fused and not located:
        raise InputError(f"{reconstruction.folder}: holds neither fused nor located frames to compare with")
    direction = overview_direction(list(fused.values()))
    candidates = located or fused
    frame = max(candidates, key=lambda candidate: float(candidates[candidate][:3, 2] @ direction))
    return Original(
        caption=f"frame {frame}" + ("" if frame in fused else ", held out of the fusion"),
        color=dataset.color(frame),
        world_from_camera=candidates[frame],
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
