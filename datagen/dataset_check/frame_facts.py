"""Reading every frame once, and keeping of each what the checks of files, depth and trajectory need."""

import hashlib
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.dataset import PARTS, Dataset, Part
from datagen.errors import InputError
from datagen.rigid import Matrix, NotRigidError

THUMBNAIL_PX = 48


@dataclass(frozen=True, kw_only=True)
class FrameFacts:
    """What is kept of a frame; None where its part could not be read.

    ``missing`` names parts whose files are not there, ``errors`` says what is wrong with those that are. ``thumbnail``
    is the depth in metres at some 48 columns. ``farthest_share`` is the share of valid pixels that lie exactly at
    ``farthest``.
    """

    frame_id: int
    missing: tuple[Part, ...]
    errors: dict[Part, str]
    reflected: bool = False
    pose: Matrix | None = None
    depth_digest: bytes | None = None
    color_digest: bytes | None = None
    valid_share: float = 0.0
    farthest: float = 0.0
    farthest_share: float = 0.0
    color_deviation: float = 0.0
    thumbnail: NDArray[np.float32] | None = None

    @property
    def is_usable(self) -> bool:
        """Whether the frame has a pose and depth to look at."""
        return self.pose is not None and self.valid_share > 0


def typical_depth(facts: list[FrameFacts]) -> float:
    """Return the median depth over frames that have any, metres."""
    thumbnails = [each.thumbnail[each.thumbnail > 0] for each in facts if each.thumbnail is not None]
    return float(np.median(np.concatenate(thumbnails)))


def read_frames(dataset: Dataset, frame_ids: tuple[int, ...], done: Callable[[], None]) -> list[FrameFacts]:
    """Read all parts of the frames, several at a time; ``done`` is called after each."""
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        facts = []
        for each in pool.map(lambda frame_id: _read(dataset, frame_id), frame_ids):
            facts.append(each)
            done()
        return facts


def _read(dataset: Dataset, frame_id: int) -> FrameFacts:
    missing = tuple(part for part in PARTS if not dataset.has(frame_id, part))
    errors: dict[Part, str] = {}
    found: dict[str, object] = {}
    readers: dict[Part, Callable[[Dataset, int], dict[str, object]]] = {
        "color": _color_facts,
        "depth": _depth_facts,
        "pose": lambda dataset, frame_id: {"pose": dataset.world_from_camera(frame_id)},
    }
    for part, read in readers.items():
        if part not in missing:
            try:
                found |= read(dataset, frame_id)
            except InputError as error:
                errors[part] = str(error)
                if isinstance(error, NotRigidError):
                    found["reflected"] = error.is_reflection
    return FrameFacts(frame_id=frame_id, missing=missing, errors=errors, **found)  # type: ignore[arg-type]


def _color_facts(dataset: Dataset, frame_id: int) -> dict[str, object]:
    image = dataset.color(frame_id)
    return {"color_digest": _digest(image), "color_deviation": float(cv2.meanStdDev(image)[1].max())}


def _depth_facts(dataset: Dataset, frame_id: int) -> dict[str, object]:
    depth = dataset.depth(frame_id)
    step = max(1, depth.shape[1] // THUMBNAIL_PX)
    facts: dict[str, object] = {"depth_digest": _digest(depth), "thumbnail": depth[::step, ::step].copy()}
    valid = int(np.count_nonzero(depth > 0))
    if valid:
        farthest = float(depth.max())
        pile = int(np.count_nonzero(depth == depth.max()))
        facts |= {"valid_share": valid / depth.size, "farthest": farthest, "farthest_share": pile / valid}
    return facts


def _digest(image: NDArray) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(image).tobytes(), digest_size=16).digest()
