"""The Brown-Conrady lens: where a point appears through it, and which point appears at a pixel.

With r² = x² + y² in coordinates of a camera of focal length 1 (D. C. Brown, "Close-Range Camera Calibration", 1971; the
denominator and the order of coefficients are OpenCV's):

    x_d = x·(1 + k1 r² + k2 r⁴ + k3 r⁶)/(1 + k4 r² + k5 r⁴ + k6 r⁶) + 2 p1 x y + p2 (r² + 2 x²)
    y_d = y·(the same) + p1 (r² + 2 y²) + 2 p2 x y
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.scene_spec.lens_settings import LensSettings

Points = NDArray[np.float64]

NEWTON_STEPS = 30
RESIDUAL = 1e-10
"""Largest distance, in focal lengths, at which a point that was found may appear from where it should."""
MAGNIFICATIONS = (0.1, 10.0)


@dataclass(frozen=True, kw_only=True)
class LensMap:
    """Where the pixels of a distorted image lie in the rendered one.

    ``camera`` is the distorted camera without its distortion. ``u`` and ``v`` (H, W) are pixel coordinates in the
    rendered image, whose size is the same; ``inside`` (H, W) tells which of them lie in it.
    """

    camera: PinholeCamera
    u: NDArray[np.float32]
    v: NDArray[np.float32]
    inside: NDArray[np.bool_]


def distort(points: Points, lens: LensSettings) -> Points:
    """Return where points (…, 2) = (x/z, y/z) appear through the lens, in focal lengths."""
    x, y = points[..., 0], points[..., 1]
    s = x * x + y * y
    radial = np.polyval(_numerator(lens), s) / np.polyval(_denominator(lens), s)
    return np.stack(
        [
            x * radial + 2 * lens.p1 * x * y + lens.p2 * (s + 2 * x * x),
            y * radial + lens.p1 * (s + 2 * y * y) + 2 * lens.p2 * x * y,
        ],
        axis=-1,
    )


def undistort(points: Points, lens: LensSettings) -> Points:
    """Return the points (…, 2) that appear at ``points`` through the lens; NaN where none does.

    Newton's method. A lens that folds the image over itself shows some points twice: the one nearer to the axis counts.
    """
    found = points.copy()
    with np.errstate(all="ignore"):
        for _ in range(NEWTON_STEPS):
            step = _newton_step(found, distort(found, lens) - points, lens)
            found -= step
            if np.nanmax(np.abs(step), initial=0) < RESIDUAL / 100:
                break
        residual = np.linalg.norm(distort(found, lens) - points, axis=-1)
        proper = (residual <= RESIDUAL) & (np.linalg.norm(found, axis=-1) < fold_radius(lens))
    found[~proper] = np.nan
    return found


def fold_radius(lens: LensSettings) -> float:
    """Return the distance from the axis, in focal lengths, from which on the lens shows farther points nearer to it.

    The smallest positive zero of d(r·L(r))/dr, L the radial factor, or of L's denominator; infinity where neither is.
    """
    numerator, denominator = _numerator(lens), _denominator(lens)
    # In s = r², d(r·N/D)/dr = ((N + 2s·N')·D − 2s·N·D')/D².
    rising: NDArray = np.polyadd(numerator, np.polymul([2, 0], np.polyder(numerator)))
    falling: NDArray = np.polymul(np.polymul([2, 0], numerator), np.polyder(denominator))
    slope: NDArray = np.polysub(np.polymul(rising, denominator), falling)
    zeros = np.concatenate([np.roots(slope), np.roots(denominator)])
    positive = zeros[(np.abs(zeros.imag) < 1e-9) & (zeros.real > 0)].real
    return float(np.sqrt(positive.min())) if positive.size else float("inf")


def distorted_camera(camera: PinholeCamera, lens: LensSettings) -> PinholeCamera:
    """Return the camera in whose pixels the lens shows its image: ``camera`` with its focal lengths magnified."""
    if lens.magnification == "cover":
        return _covering_camera(camera, lens)
    return _magnified(camera, lens.magnification)


@lru_cache(maxsize=4)
def lens_map(camera: PinholeCamera, lens: LensSettings) -> LensMap:
    """Return where the pixels that ``lens`` shows lie in the image that ``camera`` rendered."""
    shown_by = distorted_camera(camera, lens)
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    source = _rendered_pixels(np.stack([u, v], axis=-1), camera, shown_by, lens)
    return LensMap(
        camera=shown_by,
        u=source[..., 0].astype(np.float32),
        v=source[..., 1].astype(np.float32),
        inside=_is_inside(source, camera),
    )


def _rendered_pixels(pixels: Points, camera: PinholeCamera, shown_by: PinholeCamera, lens: LensSettings) -> Points:
    """Return pixel coordinates (…, 2) in the rendered image of pixels (…, 2) of the distorted one."""
    ideal = undistort((pixels - (shown_by.cx, shown_by.cy)) / (shown_by.fx, shown_by.fy), lens)
    return ideal * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def _is_inside(pixels: Points, camera: PinholeCamera) -> NDArray[np.bool_]:
    """Tell which pixel coordinates (…, 2) lie in the image, the outer halves of its outer pixels included."""
    u, v = pixels[..., 0], pixels[..., 1]
    return (u >= -0.5) & (u <= camera.width - 0.5) & (v >= -0.5) & (v <= camera.height - 0.5)


def _magnified(camera: PinholeCamera, magnification: float) -> PinholeCamera:
    return replace(camera, fx=camera.fx * magnification, fy=camera.fy * magnification)


def _covering_camera(camera: PinholeCamera, lens: LensSettings) -> PinholeCamera:
    """Return the least magnified camera of which all border pixels, and so all within, have something to show."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    pixels = np.stack([u, v], axis=-1)
    border = np.concatenate([pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]])

    def covers(magnification: float) -> bool:
        shown_by = _magnified(camera, magnification)
        return bool(_is_inside(_rendered_pixels(border, camera, shown_by, lens), camera).all())

    least, most = MAGNIFICATIONS
    if not covers(most):
        raise InputError(
            f"lens: no magnification up to {most:g} fills the distorted image; its coefficients distort too much"
        )
    for _ in range(40):
        middle = (least * most) ** 0.5
        least, most = (least, middle) if covers(middle) else (middle, most)
    return _magnified(camera, most)


def _numerator(lens: LensSettings) -> NDArray[np.float64]:
    """Return the polynomial in r², its highest power first."""
    return np.array([lens.k3, lens.k2, lens.k1, 1.0])


def _denominator(lens: LensSettings) -> NDArray[np.float64]:
    """Return the polynomial in r², its highest power first."""
    return np.array([lens.k6, lens.k5, lens.k4, 1.0])


def _newton_step(points: Points, error: Points, lens: LensSettings) -> Points:
    """Return J⁻¹·error (…, 2), J the derivatives of ``distort`` at ``points``, which are symmetric."""
    x, y = points[..., 0], points[..., 1]
    s = x * x + y * y
    n, d = np.polyval(_numerator(lens), s), np.polyval(_denominator(lens), s)
    dn, dd = np.polyval(np.polyder(_numerator(lens)), s), np.polyval(np.polyder(_denominator(lens)), s)
    radial, slope = n / d, 2 * (dn * d - n * dd) / (d * d)  # the radial factor's derivative along x is x·slope
    xx = radial + x * x * slope + 2 * lens.p1 * y + 6 * lens.p2 * x
    yy = radial + y * y * slope + 6 * lens.p1 * y + 2 * lens.p2 * x
    xy = x * y * slope + 2 * lens.p1 * x + 2 * lens.p2 * y
    determinant = xx * yy - xy * xy
    along_x = (yy * error[..., 0] - xy * error[..., 1]) / determinant
    along_y = (xx * error[..., 1] - xy * error[..., 0]) / determinant
    return np.stack([along_x, along_y], axis=-1)
