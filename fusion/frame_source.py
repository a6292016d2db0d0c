"""Decoding a dataset's frames on all cores, a batch at a time, while memory holds them."""

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import TypeVar

import numpy as np
import psutil
from numpy.typing import NDArray

from datagen.dataset import Dataset
from datagen.errors import InputError
from datagen.rigid import Matrix
from fusion.frame_batch import MAX_BATCH

FARTHEST = 10_000.0
"""Metres from the world's origin within which frames are fused; meshes are stored in single precision."""

_Pixel = TypeVar("_Pixel", bound=np.generic)

CACHE_SHARE = 0.25
"""How much of the free memory decoded depth may take, to spare a second decoding."""


class FrameSource:
    """Chosen frames of a dataset, decoded by a thread pool; a context manager.

    Depth beyond ``depth_max`` metres is taken as invalid. ``seconds`` adds up the time spent on decoding.
    """

    def __init__(self, dataset: Dataset, frame_ids: tuple[int, ...], *, depth_max: float | None) -> None:
        dataset.require(frame_ids)
        self.dataset = dataset
        self.frame_ids = frame_ids
        self.poses = {frame_id: _near_pose(dataset, frame_id) for frame_id in frame_ids}
        self.seconds = 0.0
        self._depth_max = depth_max
        image_bytes = 2 * dataset.camera.width * dataset.camera.height
        self._cache_room = int(CACHE_SHARE * psutil.virtual_memory().available / image_bytes)
        self._cache: dict[int, NDArray[np.uint16]] = {}
        self._pool = ThreadPoolExecutor(thread_name_prefix="decode")

    def __enter__(self) -> "FrameSource":
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the threads."""
        self._pool.shutdown(cancel_futures=True)

    def batches(self) -> Iterator[tuple[int, ...]]:
        """Yield the frames' numbers in groups that make a batch."""
        for first in range(0, len(self.frame_ids), MAX_BATCH):
            yield self.frame_ids[first : first + MAX_BATCH]

    def depths(self, frame_ids: tuple[int, ...]) -> list[NDArray[np.uint16]]:
        """Return planar depth images (height, width) in steps of the dataset's ``depth_scale``, 0 = invalid."""
        return self._decode(self._depth, frame_ids)

    def colors(self, frame_ids: tuple[int, ...]) -> list[NDArray[np.uint8]]:
        """Return colour images (height, width, 3), RGB."""
        return self._decode(self.dataset.color, frame_ids)

    def _decode(self, read: Callable[[int], NDArray[_Pixel]], frame_ids: tuple[int, ...]) -> list[NDArray[_Pixel]]:
        start = time.perf_counter()
        images = list(self._pool.map(read, frame_ids))
        self.seconds += time.perf_counter() - start
        return images

    def _depth(self, frame_id: int) -> NDArray[np.uint16]:
        if frame_id in self._cache:
            return self._cache[frame_id]
        depth = self.dataset.depth_steps(frame_id)
        if self._depth_max is not None:
            depth[depth > self._depth_max / self.dataset.depth_scale] = 0
        if len(self._cache) < self._cache_room:
            self._cache[frame_id] = depth
        return depth


def _near_pose(dataset: Dataset, frame_id: int) -> Matrix:
    """Read a pose; raises InputError where it lies so far out that single precision loses millimetres."""
    pose = dataset.world_from_camera(frame_id)
    distance = float(np.linalg.norm(pose[:3, 3]))
    if distance > FARTHEST:
        raise InputError(
            f"{dataset.folder}: frame {frame_id}: the camera stands {distance:.4g} m from the world's origin, more "
            f"than {FARTHEST:g} m, where single precision loses millimetres; subtract one offset from all positions"
        )
    return pose
