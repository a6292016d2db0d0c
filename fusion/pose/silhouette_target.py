"""What the model's silhouette is compared with: the query's mask, blurred, on images from small to large."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix, inverse, transform_points
from fusion.pose.pose_model import PoseModel
from fusion.pose.query import Query

_WIDTHS = (40, 80, 160, 320)
"""About how many pixels wide the levels' images are."""
FINEST = -1
_SOFTNESS_PX = (1.5, 1.2, 1.0, 0.8)
_ITERATIONS = (8, 6, 6, 8)
_ENOUGH_PX = (0.3, 0.3, 0.2, 0.03)
_ROUGH_PX = 0.3
"""Of a level's pixels: rays' nearest approaches jump between the field's cells, so costs are no smoother than that."""
_WHOLE_LEVELS = 2
"""How many of them have all pixels of their image; the others those near the mask's edge."""
_BAND_SIGMAS = 3.0
_SHARPEST_PX = 1.5
"""A Gaussian of this many pixels is left by taking every second of them: what is finer is gone."""
_NEAR_MIDDLE = 0.75


@dataclass(frozen=True, kw_only=True, eq=False)
class Level:
    """One size of the image and one width of the blur: what the silhouette is compared with.

    ``pixels`` (n, 2) of ``camera``, ``target`` (n,) the blurred mask there; ``softness_px`` in that camera's pixels. At
    most ``iterations`` are worth it; a step that moves the model by less than ``enough_px`` is the last, and so is one
    of less than ``rough_px`` that does not lead downhill.
    """

    camera: PinholeCamera
    pixels: NDArray[np.float64]
    target: NDArray[np.float64]
    softness_px: float
    iterations: int
    enough_px: float
    rough_px: float = _ROUGH_PX


def silhouette_levels(mask: NDArray[np.bool_], camera: PinholeCamera) -> list[Level]:
    """Return what the silhouette is compared with, coarse to fine, for a mask (height, width) of ``camera``."""
    return [silhouette_level(mask, camera, number) for number in range(len(_WIDTHS))]


def silhouette_level(mask: NDArray[np.bool_], camera: PinholeCamera, number: int) -> Level:
    """Return one of these levels, counted from the coarsest, or FINEST."""
    number %= len(_WIDTHS)
    step, softness_px = max(round(camera.width / _WIDTHS[number]), 1), _SOFTNESS_PX[number]
    blurred = blurred_mask(mask, softness_px * step, step)
    wanted = np.ones(blurred.shape, bool)
    if number >= _WHOLE_LEVELS:
        reach = int(np.ceil(_BAND_SIGMAS * softness_px * step))
        wanted = _near_edge(mask, reach)[::step, ::step]
    v, u = np.nonzero(wanted)
    return Level(
        camera=camera.subsampled(step),
        pixels=np.stack([u, v], axis=-1).astype(np.float64),
        target=blurred[v, u].astype(np.float64),
        softness_px=softness_px,
        iterations=_ITERATIONS[number],
        enough_px=_ENOUGH_PX[number],
    )


def blurred_mask(mask: NDArray[np.bool_], sigma_px: float, step: int) -> NDArray[np.float32]:
    """Return every ``step``-th pixel of a mask (height, width), blurred by a Gaussian of ``sigma_px`` of its pixels.

    A wide Gaussian is that of a narrow one, and then another of half the pixels: their squares add up.
    """
    image, rest, left = mask.astype(np.float32), sigma_px, step
    while left % 2 == 0 and rest > 2 * _SHARPEST_PX:
        image = _blurred(image, _SHARPEST_PX)[::2, ::2]
        rest, left = np.sqrt(rest**2 - _SHARPEST_PX**2) / 2, left // 2
    return _blurred(image, rest)[::left, ::left]


def _blurred(image: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE), np.float32)


def _near_edge(mask: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Return the pixels within ``reach`` of the mask's edge, along rows and columns."""
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    binary = mask.astype(np.uint8)
    return cv2.dilate(binary, kernel) > cv2.erode(binary, kernel)


def outline_length(mask: NDArray[np.bool_]) -> int:
    """Count the mask's pixels (height, width) that have a neighbour outside of it, within the image."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    binary = mask.astype(np.uint8)
    inner = np.asarray(cv2.erode(binary, cross), np.uint8)  # what is beyond the image erodes nothing
    return int((binary & ~inner).sum())


def silhouette_from_depth(model: PoseModel, query: Query, start: Matrix) -> NDArray[np.bool_] | None:
    """Return the mask (height, width) that depth tells: what lies no farther from the model's middle than its surface.

    The middle is where ``start`` has it, so the start has to be right to a share of the model's size. None where the
    query has no depth.
    """
    if query.depth is None:
        return None
    depth = query.valid_depth()
    middle = transform_points(inverse(start), model.centre_world)
    apart = np.linalg.norm(query.camera.back_project(depth) - middle, axis=-1)
    near = (depth > 0) & (apart < _NEAR_MIDDLE * model.diameter)
    regions, count = ndimage.label(near)
    if not count:
        return near
    sizes = np.bincount(regions.ravel())
    sizes[0] = 0
    return np.asarray(regions == sizes.argmax())
