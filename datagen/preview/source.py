"""What a preview shows: which frames, which depth, at what time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.dataset import Dataset
from datagen.errors import InputError
from datagen.preview.depth_colors import DepthScale, depth_scale

SAMPLED_IMAGES = 20
NOMINAL_FRAMES_PER_SECOND = 30.0


@dataclass(frozen=True, kw_only=True)
class PreviewSource:
    """The complete ones of the chosen frames of a dataset; ``depth_layer`` names a layer to show as depth."""

    dataset: Dataset
    frame_ids: tuple[int, ...]
    depth_layer: str | None = None

    def depth(self, frame_id: int) -> NDArray[np.float32]:
        """Return the depth (H, W) in metres that is shown of a frame."""
        if self.depth_layer is not None:
            return self.dataset.read_layer(self.depth_layer, frame_id).astype(np.float32, copy=False)
        return self.dataset.depth(frame_id)

    def scale(self) -> DepthScale:
        """Return the scale of depth for all frames, from ``SAMPLED_IMAGES`` of them."""
        images = [self.depth(frame_id) for frame_id in evenly(self.frame_ids, SAMPLED_IMAGES)]
        return depth_scale(images, source=str(self.dataset.folder))

    @property
    def frames_per_second(self) -> float:
        """How fast the chosen frames follow each other, 30 where the dataset does not say."""
        known = [t for frame_id in self.frame_ids if (t := self.dataset.timestamp_s(frame_id)) is not None]
        steps = np.diff(known)
        if len(known) < len(self.frame_ids) or steps.size == 0 or np.median(steps) <= 0:
            return NOMINAL_FRAMES_PER_SECOND
        return float(np.clip(1 / np.median(steps), 1, 120))

    def caption(self, frame_id: int) -> str:
        """Return the number of a frame and, where it is known, its time."""
        time = self.dataset.timestamp_s(frame_id)
        if time is None or abs(time) > 1e6:  # a clock's time, which tells nobody anything
            return f"frame {frame_id}"
        return f"frame {frame_id} · {time:.2f} s"


def preview_source(dataset: Dataset, frame_ids: tuple[int, ...], *, depth_layer: str | None = None) -> PreviewSource:
    """Return the frames of ``frame_ids`` that are complete; raises InputError where none is or the layer is missing."""
    if depth_layer is not None:
        path = dataset.layer_file(depth_layer, frame_ids[0])
        if not path.name.endswith(".depth.png"):
            raise InputError(f"{dataset.folder}: the layer {depth_layer} is no depth; its files are {path.name}")
    complete = tuple(frame_id for frame_id in frame_ids if dataset.is_complete(frame_id))
    if not complete:
        dataset.require(frame_ids)
    return PreviewSource(dataset=dataset, frame_ids=complete, depth_layer=depth_layer)


def evenly(frame_ids: tuple[int, ...], count: int) -> tuple[int, ...]:
    """Return at most ``count`` frames at even distances, the first and the last among them."""
    if len(frame_ids) <= count:
        return frame_ids
    chosen = np.rint(np.linspace(0, len(frame_ids) - 1, count)).astype(int)
    return tuple(frame_ids[i] for i in chosen)
