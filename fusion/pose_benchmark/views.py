"""What a query shows, exactly or as a bad day has it: a sensor's noise, a careless mask, something in the way."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix
from datagen.scene_spec.sensor_settings import SensorModel, SensorSettings
from datagen.sensors.simulate_depth import simulate_depth

OCCLUDER_COLOR = (96, 96, 96)
OCCLUDER_DEPTH = 0.8
"""Of the object's nearest depth: the occluder stands before it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """A frame whose pose is known.

    ``color`` (height, width, 3) RGB; ``depth`` (height, width) planar metres, 0 = invalid; ``mask`` (height, width) is
    True where the object is, None where all that is seen belongs to the model.
    """

    camera: PinholeCamera
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    mask: NDArray[np.bool_] | None
    world_from_camera: Matrix

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Where the model is seen with depth."""
        return self.depth > 0 if self.mask is None else self.mask & (self.depth > 0)


@dataclass(frozen=True, kw_only=True)
class Noise:
    """What spoils a view: ``sensor``, the mask's edge off by 1 to ``mask_jitter_px`` pixels, ``occluded`` at most."""

    sensor: SensorModel = "kinect-v1"
    mask_jitter_px: int = 2
    occluded: float = 0.3


def spoiled(view: View, noise: Noise, *, rng: np.random.Generator) -> View:
    """Return the view as a sensor sees it with something in the way, and the mask that a careless segmentation gives.

    The occluder stands in the scene before the sensor looks, so that it throws shadows and frays at its edges.
    """
    blocked = _occluded(view, most=noise.occluded, rng=rng)
    depth = simulate_depth(blocked.depth, view.camera, SensorSettings(model=noise.sensor), rng=rng)
    assert blocked.mask is not None
    return replace(blocked, depth=depth, mask=_jittered(blocked.mask, most_px=noise.mask_jitter_px, rng=rng))


def _occluded(view: View, *, most: float, rng: np.random.Generator) -> View:
    """Put a bar before the object, across the image at a random angle, that hides up to the share ``most`` of it."""
    seen = view.seen
    share, angle = rng.uniform(0, most), rng.uniform(0, np.pi)
    v, u = np.mgrid[: view.camera.height, : view.camera.width]
    across = u * np.cos(angle) + v * np.sin(angle)
    begin = rng.uniform(0, 1 - share)
    low, high = np.quantile(across[seen], (begin, begin + share))
    hidden = (across >= low) & (across < high)
    depth = np.where(hidden, np.float32(OCCLUDER_DEPTH) * view.depth[seen].min(), view.depth)
    color = np.where(hidden[..., None], np.array(OCCLUDER_COLOR, np.uint8), view.color)
    return replace(view, depth=depth.astype(np.float32), color=color, mask=seen & ~hidden)


def _jittered(mask: NDArray[np.bool_], *, most_px: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Grow or shrink a mask by 1 to ``most_px`` pixels."""
    side = 2 * int(rng.integers(1, most_px + 1)) + 1
    change = cv2.dilate if rng.random() < 0.5 else cv2.erode
    return change(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
