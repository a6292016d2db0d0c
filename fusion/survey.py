"""A first look at the frames: the volume's bounds and the scale of what they show."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import Matrix, transform_points

_TILE = 8


@dataclass(frozen=True, kw_only=True)
class FrameSurvey:
    """What one depth image covers.

    ``low``, ``high`` (3,) metres, world: the box around its frustum cut at the observed depth, None where no pixel is
    valid; ``median_depth`` metres; ``surface_area`` m², of the surface as if it faced the camera: a lower bound.
    """

    low: NDArray[np.float64] | None
    high: NDArray[np.float64] | None
    median_depth: float
    surface_area: float


@dataclass(frozen=True, kw_only=True)
class SceneSurvey:
    """What all frames cover: the union of their frusta cut at the observed depth.

    ``low``, ``high`` (3,) metres, world; ``pixel_footprint`` metres: the typical width of a pixel on the surface;
    ``typical_extent`` metres: the longest side of a box around the middle of the frames' boxes, which a few stray
    depths do not move; ``largest_area`` m²: the most surface that one frame sees.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    pixel_footprint: float
    typical_extent: float
    largest_area: float


def survey_frame(camera: PinholeCamera, depth: NDArray[np.float32], world_from_camera: Matrix) -> FrameSurvey:
    """Survey one planar depth image (height, width), metres, 0 = invalid.

    The box is conservative: it is taken over 8×8 tiles, around the corners of each tile's frustum between its smallest
    and its largest depth.
    """
    valid = depth[depth > 0]
    if valid.size == 0:
        return FrameSurvey(low=None, high=None, median_depth=0.0, surface_area=0.0)
    largest = _tiles(depth, 0.0).max(axis=(1, 3))
    smallest = _tiles(np.where(depth > 0, depth, np.inf), np.inf).min(axis=(1, 3))
    v, u = np.nonzero(largest > 0)
    corners = np.array([(-0.5, -0.5), (_TILE - 0.5, -0.5), (-0.5, _TILE - 0.5), (_TILE - 0.5, _TILE - 0.5)])
    pixels = _TILE * np.stack([u, v], axis=-1)[:, None, :] + corners
    pixels = np.minimum(pixels, (camera.width - 0.5, camera.height - 0.5))
    rays = np.concatenate(
        [(pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones((*pixels.shape[:2], 1))], axis=-1
    )
    points = [transform_points(world_from_camera, rays * z[v, u, None, None]) for z in (smallest, largest)]
    return FrameSurvey(
        low=np.min(points, axis=(0, 1, 2)),
        high=np.max(points, axis=(0, 1, 2)),
        median_depth=float(np.median(valid[::7])),
        surface_area=float(np.square(valid, dtype=np.float64).sum() / (camera.fx * camera.fy)),
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
        largest_area=max(survey.surface_area for survey in surveys),
    )


def _tiles(image: NDArray[np.floating], fill: float) -> NDArray[np.floating]:
    """Return (height, width) as (rows of tiles, 8, columns of tiles, 8), filled up at the right and the bottom."""
    height, width = image.shape
    padded = np.pad(image, ((0, -height % _TILE), (0, -width % _TILE)), constant_values=fill)
    return padded.reshape(padded.shape[0] // _TILE, _TILE, padded.shape[1] // _TILE, _TILE)
