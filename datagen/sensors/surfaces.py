"""Surfaces in a depth image: their slope, how steeply they are seen, and where one ends.

Everything is done in inverse depth w = 1/z, because a plane is affine there: n·P = c with P = z·(x̂, ŷ, 1) gives
w = n·(x̂, ŷ, 1)/c, x̂ = (u − cx)/fx, ŷ = (v − cy)/fy. So differences of w between pixels are exact on planes, and the
normal follows from them: n/c = (fx·∂w/∂u, fy·∂w/∂v, w − x̂·fx·∂w/∂u − ŷ·fy·∂w/∂v).
"""

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

SURFACE_TOLERANCE = 0.01
"""Share of its depth by which a point may leave the plane through its neighbours and still lie on their surface."""

_NO_DIFFERENCE = np.float32(1e9)


def inverse_depth(depth: NDArray) -> Image:
    """Return 1/z (H, W) in 1/m of planar depth in metres; 0 stays 0, invalid."""
    z = np.asarray(depth, dtype=np.float32)
    return np.divide(np.float32(1), z, out=np.zeros_like(z), where=z > 0)


def inverse_depth_slopes(w: Image, *, tolerance: float = SURFACE_TOLERANCE) -> tuple[Image, Image]:
    """Return ∂w/∂u and ∂w/∂v (H, W each), 1/m a pixel, of inverse depth ``w``, without reaching across edges.

    Where a pixel and its neighbours lie in line within ``tolerance`` of their depth it is the central difference, else
    the difference to the neighbour that lies on the pixel's surface; 0 where neither does.
    """
    along_v = _slope_along_u(np.ascontiguousarray(w.T), np.float32(tolerance))
    return _slope_along_u(w, np.float32(tolerance)), np.ascontiguousarray(along_v.T)


def _slope_along_u(w: Image, tolerance: np.float32) -> Image:
    difference = np.full((w.shape[0], w.shape[1] + 1), _NO_DIFFERENCE)
    valid = w > 0
    np.subtract(w[:, 1:], w[:, :-1], out=difference[:, 1:-1], where=valid[:, 1:] & valid[:, :-1])
    limit = tolerance * w
    before, after = difference[:, :-1], difference[:, 1:]
    straight = (np.abs(after - before) <= limit) & (np.abs(after) < _NO_DIFFERENCE)
    # A one-sided difference is a slope only where that side is known to be surface: two pixels in line, or close.
    after_is_slope, before_is_slope = np.abs(after) <= limit, np.abs(before) <= limit
    after_is_slope[:, :-1] |= straight[:, 1:]
    before_is_slope[:, 1:] |= straight[:, :-1]
    one_sided = np.where(after_is_slope, after, np.where(before_is_slope, before, np.float32(0)))
    return np.where(straight, np.float32(0.5) * (before + after), one_sided)


def cos_incidence(w: Image, slopes: tuple[Image, Image], camera: PinholeCamera) -> Image:
    """Return the cosine (H, W) between the surface normal and the ray to each pixel; 1 is seen straight on.

    From n·(x̂, ŷ, 1) = w for the unscaled normal n/c of the module's formula. 1 where ``w`` is invalid.
    """
    x, y = _rays(camera)
    nx, ny = slopes[0] * np.float32(camera.fx), slopes[1] * np.float32(camera.fy)
    nz = w - x * nx - y * ny
    lengths = np.sqrt((nx * nx + ny * ny + nz * nz) * (x * x + y * y + 1))
    cosine = np.divide(w, lengths, out=np.ones_like(w), where=w > 0)
    return np.minimum(cosine, np.float32(1))


def cos_incidence_of_normals(normals: NDArray[np.floating], camera: PinholeCamera) -> Image:
    """Return the cosine (H, W) between unit normals (H, W, 3), camera axes, and the rays; 1 where a normal is 0 0 0."""
    x, y = _rays(camera)
    n = np.asarray(normals, dtype=np.float32)
    along = np.abs(n[..., 0] * x + n[..., 1] * y + n[..., 2]) / np.sqrt(x * x + y * y + 1)
    return np.where((n == 0).all(axis=-1), np.float32(1), np.minimum(along, np.float32(1)))


def _rays(camera: PinholeCamera) -> tuple[Image, Image]:
    """Return x̂ (1, W) and ŷ (H, 1)."""
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    return x.astype(np.float32)[None, :], y.astype(np.float32)[:, None]


def continuous_along_u(w: Image, *, tolerance: float) -> Mask:
    """Tell (H, W − 1) whether pixels u and u + 1 lie on one surface.

    They do where their difference is at most ``tolerance`` of ``w``, or is that within ``tolerance`` which the surface
    on either side leads to expect. Never where one of them is invalid.
    """
    valid = (w[:, 1:] > 0) & (w[:, :-1] > 0)
    difference = w[:, 1:] - w[:, :-1]
    limit = np.float32(tolerance) * np.minimum(w[:, 1:], w[:, :-1])
    near = np.abs(difference) <= limit
    bend = np.abs(difference[:, 1:] - difference[:, :-1])
    both = valid[:, 1:] & valid[:, :-1]
    near[:, 1:] |= (bend <= limit[:, 1:]) & both
    near[:, :-1] |= (bend <= limit[:, :-1]) & both
    return near & valid


def depth_edges(w: Image, *, tolerance: float = SURFACE_TOLERANCE) -> Mask:
    """Tell (H, W) which valid pixels have a neighbour, of four, on another surface or without depth."""
    across = ~continuous_along_u(w, tolerance=tolerance)
    down = ~continuous_along_u(w.T, tolerance=tolerance).T
    edge = np.zeros(w.shape, dtype=np.bool_)
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge & (w > 0)
