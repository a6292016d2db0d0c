"""Where a depth sensor gives nothing: out of its second view's sight, at grazing angles, at edges."""

import cv2
import numpy as np

from datagen.sensors.surfaces import Image, Mask

SHADOW_TOLERANCE_PX = np.float32(1.5)
"""By so much disparity something must be nearer to hide a pixel: a steep surface does not hide itself."""


def unseen_by_second_view(w: Image, *, disparity_px_m: float, needs_image: bool) -> Mask:
    """Tell (H, W) which pixels of inverse depth ``w`` a view to the right does not see.

    ``disparity_px_m`` is focal length in pixels times baseline in metres: a point at column u is at column
    u − disparity_px_m·w there. Of what falls on one column the nearest hides the rest, so that the shadow of an object
    lies to its left. With ``needs_image`` pixels that leave that view at its left count as unseen too (a band
    disparity_px_m/z wide); a projector lights beyond the image.
    """
    height, width = w.shape
    disparity = w * np.float32(disparity_px_m)
    columns = np.arange(width, dtype=np.float32) - disparity
    offset = int(np.ceil(disparity.max(initial=0))) + 1
    stride = width + offset + 2
    left = np.floor(columns).astype(np.int32) + offset
    start = left + (np.arange(height, dtype=np.int32) * stride)[:, None]
    nearest = np.zeros(height * stride, dtype=np.float32)
    # A pixel covers the two columns that it lies between, so that a stretched surface leaves no gaps to see through.
    np.maximum.at(nearest, start.ravel(), disparity.ravel())
    np.maximum.at(nearest, start.ravel() + 1, disparity.ravel())
    unseen = nearest[start + (columns + offset - left >= 0.5)] > disparity + SHADOW_TOLERANCE_PX
    return unseen | (columns < -0.5) if needs_image else unseen


def grazing_loss(theta: Image, grazing_deg: tuple[float, float]) -> Image:
    """Return the probability (H, W) that a return is lost at incidence angle θ (radians): 0 to 1 over the range."""
    start, end = np.radians(grazing_deg)
    return np.clip((theta - np.float32(start)) / np.float32(end - start), 0, 1)


def neighbourhood(edges: Mask) -> Mask:
    """Tell (H, W) which pixels are at an edge of depth or touch one that is."""
    return cv2.dilate(edges.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
