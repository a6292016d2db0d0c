"""Colour and depth as a distorted lens shows them."""

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.sensors.lens import LensMap
from datagen.sensors.surfaces import Image, continuous_along_u, inverse_depth, inverse_depth_slopes

ONE_SURFACE = 0.002
"""Share of its depth by which a point may leave the plane of those beside it and still be averaged with them."""
LARGEST_STEP = np.float32(0.05)
"""Share of its depth by which a surface may change over half a pixel."""


def distort_color(color: NDArray[np.uint8], lens_map: LensMap) -> NDArray[np.uint8]:
    """Return colour (H, W, 3) through the lens, bilinear; black where the rendered image has nothing.

    Coordinates are OpenCV's 1/32 pixel. Its bicubic filter is sharper and displaces edges by up to a tenth of a pixel.
    """
    shown = cv2.remap(color, lens_map.u, lens_map.v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    shown[~lens_map.inside] = 0
    return shown.astype(np.uint8, copy=False)


def distort_depth(depth: NDArray[np.floating], lens_map: LensMap) -> Image:
    """Return planar depth (H, W) in metres through the lens, 0 where the rendered image has none.

    It stays z along the same axis. Where four pixels around a point lie on one surface, inverse depth is bilinear
    between them; elsewhere the nearest pixel's plane is followed to the point. Both are exact on planes, of second
    order on curved surfaces, and never average surfaces that are farther apart than ``ONE_SURFACE``.
    """
    w = inverse_depth(depth)
    u, v = np.where(lens_map.inside, (lens_map.u, lens_map.v), np.float32(0))
    shown = _along_nearest_plane(w, u, v)
    if min(w.shape) > 1:
        smooth, exact = _bilinear(w, u, v)
        np.copyto(shown, smooth, where=exact)
    shown[~lens_map.inside] = 0
    return inverse_depth(shown)


def _along_nearest_plane(w: Image, u: Image, v: Image) -> Image:
    """Return inverse depth at (u, v), extrapolated from the nearest pixel with its slope."""
    height, width = w.shape
    column = np.clip(np.rint(u), 0, width - 1).astype(np.intp)
    row = np.clip(np.rint(v), 0, height - 1).astype(np.intp)
    slope_u, slope_v = inverse_depth_slopes(w, tolerance=ONE_SURFACE)
    nearest = w[row, column]
    step = slope_u[row, column] * (u - column) + slope_v[row, column] * (v - row)
    step[np.abs(step) > LARGEST_STEP * nearest] = 0
    return nearest + step.astype(np.float32)


def _bilinear(w: Image, u: Image, v: Image) -> tuple[Image, NDArray[np.bool_]]:
    """Return inverse depth at (u, v) between the four pixels around, and where these lie on one surface."""
    height, width = w.shape
    column = np.clip(np.floor(u), 0, width - 2).astype(np.intp)
    row = np.clip(np.floor(v), 0, height - 2).astype(np.intp)
    right, down = (u - column).astype(np.float32), (v - row).astype(np.float32)
    above = w[row, column] * (1 - right) + w[row, column + 1] * right
    below = w[row + 1, column] * (1 - right) + w[row + 1, column + 1] * right
    along_u = continuous_along_u(w, tolerance=ONE_SURFACE)
    along_v = continuous_along_u(np.ascontiguousarray(w.T), tolerance=ONE_SURFACE).T
    one_surface = along_u[:-1] & along_u[1:] & along_v[:, :-1] & along_v[:, 1:]
    return above * (1 - down) + below * down, one_surface[row, column]
