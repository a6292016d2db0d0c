"""A first look at the frames: the volume's bounds and the scale of what they show."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import Matrix

_TILE = 8
_MEDIAN_STRIDE = 37
"""Every so many pixels are enough for a median depth."""


@dataclass(frozen=True, kw_only=True)
class FrameSurvey:
    """What one depth image covers.

    ``low``, ``high`` (3,) metres, world: the box around its frustum cut at the observed depth, None where no pixel is
    valid; ``median_depth`` and ``farthest`` metres; ``surface_area`` m², of the surface as if it faced the camera: a
    lower bound.
    """

    low: NDArray[np.float64] | None
    high: NDArray[np.float64] | None
    median_depth: float
    farthest: float
    surface_area: float


@dataclass(frozen=True, kw_only=True)
class SceneSurvey:
    """What all frames cover: the union of their frusta cut at the observed depth.

    ``low``, ``high`` (3,) metres, world; ``pixel_footprint`` metres: the typical width of a pixel on the surface;
    ``typical_extent`` metres: the longest side of a box around the middle of the frames' boxes, which a few stray
    depths do not move.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    pixel_footprint: float
    typical_extent: float


def survey_frame(
    camera: PinholeCamera, steps: NDArray[np.uint16], world_from_camera: Matrix, *, depth_scale: float
) -> FrameSurvey:
    """Survey one planar depth image (height, width), in steps of ``depth_scale`` metres, 0 = invalid.

    The box is conservative: it is taken over 8×8 tiles, around the corners of each tile's frustum between its smallest
    and its largest depth.
    """
    largest = _over_tiles(np.maximum, steps)
    seen = largest > 0
    if not seen.any():
        return FrameSurvey(low=None, high=None, median_depth=0.0, farthest=0.0, surface_area=0.0)
    # Invalid pixels, 0, wrap round to the largest number, which is the smallest nowhere else.
    smallest = _over_tiles(np.minimum, steps - np.uint16(1))[seen] + 1.0
    low, high = _frustum_box(camera, world_from_camera, seen, depth_scale * smallest, depth_scale * largest[seen])
    some = steps.ravel()[::_MEDIAN_STRIDE]
    some = some[some > 0]
    return FrameSurvey(
        low=low,
        high=high,
        median_depth=depth_scale * float(np.median(some if some.size else largest[seen])),
        farthest=depth_scale * float(largest.max()),
        surface_area=depth_scale**2 * cv2.norm(steps, cv2.NORM_L2SQR) / (camera.fx * camera.fy),
    )


def combine(surveys: Sequence[FrameSurvey], camera: PinholeCamera) -> SceneSurvey:
    """Return the union of the frames' surveys; raises InputError where no frame has a valid depth."""
    seen = [(survey.low, survey.high) for survey in surveys if survey.low is not None and survey.high is not None]
    if not seen:
        raise InputError(
            f"none of the {len(surveys)} chosen frames has a valid depth; check depth_scale and --depth-max"
        )
    lows, highs = (np.array(corner) for corner in zip(*seen, strict=True))
    spread = np.quantile(highs, 0.9, axis=0) - np.quantile(lows, 0.1, axis=0)
    depths = [survey.median_depth for survey in surveys if survey.low is not None]
    return SceneSurvey(
        low=lows.min(axis=0),
        high=highs.max(axis=0),
        pixel_footprint=float(np.median(depths)) / max(camera.fx, camera.fy),
        typical_extent=float(spread.max()),
    )


def _over_tiles(largest_or_smallest: np.ufunc, image: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return the largest or the smallest of each tile; at the right and the bottom tiles may be cut."""
    height, width = image.shape
    if height % _TILE or width % _TILE:
        image = np.pad(image, ((0, -height % _TILE), (0, -width % _TILE)), mode="edge")
    # By halves, so that NumPy's loops run along whole rows: ten times faster than its reductions over short axes.
    for _ in range(_TILE.bit_length() - 1):
        image = largest_or_smallest(image[0::2], image[1::2])
    for _ in range(_TILE.bit_length() - 1):
        image = largest_or_smallest(image[:, 0::2], image[:, 1::2])
    return image


def _frustum_box(
    camera: PinholeCamera,
    world_from_camera: Matrix,
    seen: NDArray[np.bool_],
    nearest: NDArray[np.float64],
    farthest: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners of the box around the frusta of the tiles that are ``seen``, (n,) metres from near to far.

    A coordinate in the world is z (r₀ x + r₁ y + r₂) + t, with x and y the slopes of a corner's ray: its extremes over
    a tile's corners are those of r₀ x and of r₁ y, added.
    """
    rows, columns = seen.shape
    x = (np.minimum(_TILE * np.arange(columns + 1), camera.width) - 0.5 - camera.cx) / camera.fx
    y = (np.minimum(_TILE * np.arange(rows + 1), camera.height) - 0.5 - camera.cy) / camera.fy
    row, column = np.nonzero(seen)
    low, high = world_from_camera[:3, 3].copy(), world_from_camera[:3, 3].copy()
    for axis, (along_x, along_y, along_z) in enumerate(world_from_camera[:3, :3]):
        ends_x = np.sort(along_x * np.stack([x[:-1], x[1:]]), axis=0)
        ends_y = np.sort(along_y * np.stack([y[:-1], y[1:]]), axis=0)
        least = ends_x[0, column] + ends_y[0, row] + along_z
        most = ends_x[1, column] + ends_y[1, row] + along_z
        low[axis] += (least * np.where(least < 0, farthest, nearest)).min()
        high[axis] += (most * np.where(most > 0, farthest, nearest)).max()
    return low, high
