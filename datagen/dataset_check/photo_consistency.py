"""How far colour lies beside depth: the same surface points must have the same colour in two images.

A view of a plain wall or of a floor has no edges of depth to be found again in colour. But where the camera turns,
tilts or comes closer between two images, a point's offset colour comes from different places of the surface.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.dataset_check.color_alignment import largest_offset
from datagen.dataset_check.views import smooth_pixels

POINTS = 4000
LEAST_POINTS = 60
LEAST_PAIRS = 6
SATURATION = 60.0
"""Grey levels of difference that cost half of the most: occlusions and highlights differ by much, and mean nothing."""

SAME_DEPTH = 0.03
"""Relative difference of depth up to which a point is taken for visible in the other image."""

TELLING_PX = 1.5
"""Offsets that lie so far from the best one must be clearly worse."""

LEAST_SIGNIFICANCE = 4.0


@dataclass(frozen=True, kw_only=True)
class View:
    """``color`` (H, W, 3), ``depth`` (H, W) metres, 0 invalid, and ``world_from_camera`` (4, 4)."""

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    world_from_camera: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class PhotoConsistency:
    """The offset (x, y) of colour beside depth at which images agree best.

    ``significance`` is by how many standard errors between pairs it is better than any offset ``TELLING_PX`` away,
    ``lead`` than those less than ``TELLING_PX`` from none: colour may surely be off, though not by how much.
    """

    offset_px: tuple[float, float]
    significance: float
    lead: float
    pairs: int

    @property
    def length_px(self) -> float:
        """Length of the offset."""
        return float(np.hypot(*self.offset_px))

    @property
    def is_clear(self) -> bool:
        """Whether the images tell one offset from all others, or that there is one."""
        return max(self.significance, self.lead) >= LEAST_SIGNIFICANCE


def measure_photo_consistency(
    pairs: list[tuple[View, View]], camera: PinholeCamera, rng: np.random.Generator
) -> PhotoConsistency | None:
    """Compare colours of the same points over all offsets; None where too few images share surfaces.

    For an offset o, a point at pixels p and q of two images costs |I(p + o) − J(q + o)|, saturating. What differs
    between the images changes the place p + o − q by a part of o only, so that every second offset is tried first.
    Rests on right poses and intrinsics.
    """
    reach = largest_offset(camera.width)
    shared = [each for pair in pairs if (each := _seen_in_both(*pair, camera, reach, rng)) is not None]
    if len(shared) < LEAST_PAIRS:
        return None
    coarse = _square(reach - reach % 2, step=2)
    costs = np.array([_costs(each, coarse) for each in shared])
    fine = coarse[costs.mean(axis=0).argmin()] + _square(2, step=1)
    fine = fine[np.abs(fine).max(axis=1) <= reach]
    offsets = np.concatenate([coarse, fine])
    costs = np.concatenate([costs, [_costs(each, fine) for each in shared]], axis=1)
    best = int(costs.mean(axis=0).argmin())
    worse = costs - costs[:, best, None]
    error = np.maximum(worse.std(axis=0, ddof=1) / np.sqrt(len(worse)), 1e-9)
    errors_worse = worse.mean(axis=0) / error
    apart = np.hypot(*(offsets - offsets[best]).T) >= TELLING_PX
    none = np.hypot(*offsets.T) < TELLING_PX
    # What agrees ever better up to the last offset that is tried has a trend, and no best place.
    has_best = np.abs(offsets[best]).max() < np.abs(coarse).max()
    return PhotoConsistency(
        offset_px=(float(offsets[best, 0]), float(offsets[best, 1])),
        significance=float(errors_worse[apart].min()),
        lead=float(errors_worse[none].min()) if has_best else 0.0,
        pairs=len(shared),
    )


def _square(reach: int, *, step: int) -> NDArray[np.int64]:
    """Return offsets (n, 2), x and y, of up to ``reach``."""
    steps = np.arange(-reach, reach + 1, step)
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


@dataclass(frozen=True, kw_only=True)
class _SharedPoints:
    """Points that two images see: at integer pixels (n, 2) of the one and at (n, 2) of the other, and both in grey."""

    source: NDArray[np.float32]
    target: NDArray[np.float32]
    source_pixels: NDArray[np.int64]
    target_pixels: NDArray[np.float64]


def _costs(points: _SharedPoints, offsets: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the mean cost at each of the ``offsets`` (n, 2)."""
    columns, rows = offsets.T
    here = points.source[points.source_pixels[:, 1:] + rows, points.source_pixels[:, :1] + columns]
    x = (points.target_pixels[:, :1] + columns).astype(np.float32)
    y = (points.target_pixels[:, 1:] + rows).astype(np.float32)
    difference = np.abs(here - cv2.remap(points.target, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    return np.asarray((difference / (difference + SATURATION)).mean(axis=0, dtype=np.float64))


def _seen_in_both(
    source: View, target: View, camera: PinholeCamera, reach: int, rng: np.random.Generator
) -> _SharedPoints | None:
    """Draw points of the source that the target sees, ``reach`` inside both borders."""
    u, v = _smooth_pixels(source, reach, rng)
    z = source.depth[v, u].astype(np.float64)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z, np.ones_like(z)])
    x, y, z = (np.linalg.inv(target.world_from_camera) @ source.world_from_camera @ points)[:3]
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (z > 0) & (x >= reach) & (x <= camera.width - 1 - reach)
    inside &= (y >= reach) & (y <= camera.height - 1 - reach)
    u, v, x, y, z = u[inside], v[inside], x[inside], y[inside], z[inside]
    seen = np.abs(target.depth[np.rint(y).astype(np.int64), np.rint(x).astype(np.int64)] - z) < SAME_DEPTH * z
    if np.count_nonzero(seen) < LEAST_POINTS:
        return None
    source_grey, target_grey = (view.color.astype(np.float32).mean(axis=2) for view in (source, target))
    return _SharedPoints(
        source=source_grey,
        target=target_grey,
        source_pixels=np.stack([u[seen], v[seen]], axis=1),
        target_pixels=np.stack([x[seen], y[seen]], axis=1),
    )


def _smooth_pixels(view: View, reach: int, rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Draw pixels on smooth surfaces, whatever their colour: a choice by contrast would favour some offsets."""
    inside = smooth_pixels(view.depth)[reach:-reach, reach:-reach]
    v, u = np.nonzero(inside)
    chosen = rng.choice(len(u), min(POINTS, len(u)), replace=False)
    return u[chosen] + reach, v[chosen] + reach
