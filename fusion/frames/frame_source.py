"""Decoding a dataset's frames on all cores: the next batch while the caller works on this one."""

import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from types import TracebackType
from typing import TypeAlias

import numpy as np
import psutil
from numpy.typing import NDArray

from datagen.dataset import Dataset
from datagen.errors import InputError
from datagen.images import DEPTH_INVALID_MAX, clear_beyond
from datagen.rigid import Matrix
from fusion.devices import core_count
from fusion.frames import survey
from fusion.frames.frame_batch import MAX_BATCH
from fusion.frames.survey import FrameSurvey

FARTHEST = 10_000.0
"""Metres from the world's origin within which frames are fused; meshes are stored in single precision."""

CACHE_BYTES = 256 << 20
"""How much decoded depth is kept at most, to spare a second decoding: 436 images of 640×480."""

CACHE_SHARE = 1 / 8
"""Of the free memory, on smaller machines."""

Depth: TypeAlias = NDArray[np.uint16]
Color: TypeAlias = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class DecodedFrames:
    """A batch's frames as they lie on the host.

    ``depths`` (height, width) uint16 planar depth in steps of the dataset's ``depth_scale``, 0 = invalid; ``colors``
    (height, width, 3) uint8 RGB, None where they were not asked for; ``poses`` world_from_camera.
    """

    frame_ids: tuple[int, ...]
    depths: list[Depth]
    colors: list[Color] | None
    poses: list[Matrix]


class FrameSource:
    """Chosen frames of a dataset, decoded by a thread pool; a context manager.

    Depth beyond ``depth_max`` metres is taken as invalid. ``surveys`` has what each frame covers once its depth was
    decoded. ``decoding_seconds`` adds up the processor time of all threads, which work while the caller does;
    ``waiting_seconds`` is how long the caller was kept waiting.
    """

    def __init__(
        self, dataset: Dataset, frame_ids: tuple[int, ...], *, depth_max: float | None, batch_size: int = MAX_BATCH
    ) -> None:
        dataset.require(frame_ids)
        self.dataset = dataset
        self.frame_ids = frame_ids
        self.batch_size = min(batch_size, len(frame_ids))
        self.poses = {
            i: near_origin(dataset.world_from_camera(i), source=f"{dataset.folder}: frame {i}") for i in frame_ids
        }
        self.surveys: dict[int, FrameSurvey] = {}
        self.decoding_seconds = 0.0
        self.waiting_seconds = 0.0
        self._last_step = DEPTH_INVALID_MAX - 1
        if depth_max is not None:
            self._last_step = min(self._last_step, int(depth_max / dataset.depth_scale))
        survey.load()
        cache_bytes = min(CACHE_BYTES, int(CACHE_SHARE * psutil.virtual_memory().available))
        self._cache_room = cache_bytes // (2 * dataset.camera.width * dataset.camera.height)
        self._cache: dict[int, Depth] = {}
        self._lock = threading.Lock()
        # More threads than cores would only take them from the kernels in turn.
        self._pool = ThreadPoolExecutor(core_count(), thread_name_prefix="decode")

    def __enter__(self) -> "FrameSource":
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the threads, after the images that they are at, and forget what was decoded."""
        self._pool.shutdown(cancel_futures=True)
        self._cache.clear()

    def depth_batches(self) -> Iterator[DecodedFrames]:
        """Yield all frames, without colour, batch by batch."""
        return self._batches(with_color=False)

    def batches(self) -> Iterator[DecodedFrames]:
        """Yield all frames, batch by batch."""
        return self._batches(with_color=True)

    def _batches(self, *, with_color: bool) -> Iterator[DecodedFrames]:
        groups = [
            self.frame_ids[first : first + self.batch_size] for first in range(0, len(self.frame_ids), self.batch_size)
        ]
        ahead = self._submit(groups[0], with_color)
        for number, frame_ids in enumerate(groups):
            this = ahead
            # Before waiting, so that no thread is idle until the last image of this batch is there.
            ahead = self._submit(groups[number + 1], with_color) if number + 1 < len(groups) else []
            start = time.perf_counter()
            images = [future.result() for future in this]
            self.waiting_seconds += time.perf_counter() - start
            yield DecodedFrames(
                frame_ids=frame_ids,
                depths=[depth for depth, _ in images],
                colors=[color for _, color in images if color is not None] if with_color else None,
                poses=[self.poses[frame_id] for frame_id in frame_ids],
            )

    def _submit(self, frame_ids: tuple[int, ...], with_color: bool) -> list[Future[tuple[Depth, Color | None]]]:
        return [self._pool.submit(self._decode, frame_id, with_color) for frame_id in frame_ids]

    def _decode(self, frame_id: int, with_color: bool) -> tuple[Depth, Color | None]:
        start = time.thread_time()
        depth = self._depth(frame_id)
        color = self.dataset.color(frame_id) if with_color else None
        with self._lock:
            self.decoding_seconds += time.thread_time() - start
        return depth, color

    def _depth(self, frame_id: int) -> Depth:
        if frame_id in self._cache:
            return self._cache[frame_id]
        depth = self.dataset.depth_steps(frame_id)
        if self._last_step < DEPTH_INVALID_MAX - 1:  # beyond that, reading has cleared it
            clear_beyond(depth, self._last_step, out=depth)
        if frame_id not in self.surveys:
            self.surveys[frame_id] = survey.survey_frame(
                self.dataset.camera, depth, self.poses[frame_id], depth_scale=self.dataset.depth_scale
            )
        if len(self._cache) < self._cache_room:
            self._cache[frame_id] = depth
        return depth


def near_origin(world_from_camera: Matrix, *, source: str) -> Matrix:
    """Return a pose; raises InputError where it lies so far out that single precision loses millimetres."""
    distance = float(np.linalg.norm(world_from_camera[:3, 3]))
    if distance > FARTHEST:
        raise InputError(
            f"{source}: the camera stands {distance:.4g} m from the world's origin, more than {FARTHEST:g} m, where "
            "single precision loses millimetres; subtract one offset from all positions"
        )
    return world_from_camera
