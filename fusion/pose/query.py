"""A view whose pose is asked for, and its depth as points."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from fusion.devices import Device

MOST_POINTS = 8000
"""Of a query's pixels that are compared with the model, where their noise is no more than the model's."""

EVEN_AT = (100, 300, 500, 2000, MOST_POINTS)
"""How many points of a cloud are spread evenly over the image: so many are asked for before all are."""
_BAND_PX = 16

_NOISE_BINS = 8
_LEAST_PIXELS_A_BIN = 30
_NOISE_PIXELS = 12_000
"""That tell the noise, at most, about: of so many the standard deviation is right to a percent."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Query:
    """What is known of the view.

    ``depth`` (height, width) float32 planar metres, 0 = invalid; ``color`` (height, width, 3) uint8 RGB; ``mask``
    (height, width) bool, True where the object is. Raises InputError for images that are not of the camera's size.
    """

    camera: PinholeCamera
    depth: NDArray[np.float32] | None = None
    color: NDArray[np.uint8] | None = None
    mask: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        """Refuse images of another size."""
        for name in ("depth", "color", "mask"):
            image = getattr(self, name)
            if image is not None and image.shape[:2] != (self.camera.height, self.camera.width):
                raise InputError(
                    f"query: its {name} has {image.shape[1]}×{image.shape[0]} pixels, its camera"
                    f" {self.camera.width}×{self.camera.height}; give images of one size"
                )

    def valid_depth(self) -> NDArray[np.float32]:
        """Return depth with 0 wherever it is not finite, not positive, or outside the mask.

        Raises InputError where the query has no depth.
        """
        self.whole_depth()
        return self._valid

    def whole_depth(self) -> NDArray[np.float32]:
        """Return depth with 0 wherever it is not finite or not positive, outside the mask too; errors as above."""
        if self.depth is None:
            raise InputError("query: has no depth image; refine it by its silhouette")
        return self._whole

    @cached_property
    def _valid(self) -> NDArray[np.float32]:
        valid = self._whole if self.mask is None else np.where(self.mask, self._whole, np.float32(0))
        valid.flags.writeable = False
        return valid

    @cached_property
    def noise(self) -> "DepthNoise":
        """The noise of its depth within the mask, as the image itself shows it; InputError as above."""
        return depth_noise(self.valid_depth())

    @cached_property
    def _whole(self) -> NDArray[np.float32]:
        assert self.depth is not None
        whole = np.where(np.isfinite(self.depth) & (self.depth > 0), self.depth, 0).astype(np.float32, copy=False)
        whole.flags.writeable = False  # it is handed out again
        return whole


@dataclass(frozen=True, kw_only=True, eq=False)
class QueryCloud:
    """A query's depth as points in the camera frame, on a device.

    ``points`` (n,) vec3; all, and the first so many that ``EVEN_AT`` names, are spread evenly over the image.
    ``sigmas`` (n,) is the noise of their depth, metres, as the image itself shows it. ``count`` is n.
    """

    points: wp.array
    sigmas: wp.array
    sigma_median: float
    points_camera: NDArray[np.float64]

    @property
    def count(self) -> int:
        """The number of points."""
        return len(self.points_camera)


def query_cloud(query: Query, *, device: Device, most: int = MOST_POINTS) -> QueryCloud:
    """Return up to ``most`` of a query's points on a device."""
    depth = query.valid_depth()
    chosen = _neighbours_together(_first_valid(depth, most), depth.shape[1])
    v, u = np.divmod(chosen, depth.shape[1])
    z = depth[v, u].astype(np.float64)
    camera = query.camera
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
    sigmas = query.noise(z)
    return QueryCloud(
        points=wp.array(points.astype(np.float32), dtype=wp.vec3, device=device),
        sigmas=wp.array(sigmas.astype(np.float32), dtype=float, device=device),
        sigma_median=float(np.median(sigmas)) if len(sigmas) else 0.0,
        points_camera=points,
    )


def _first_valid(depth: NDArray[np.float32], most: int) -> NDArray[np.int64]:
    """Return up to ``most`` valid pixels of a depth image, numbered row by row, in an order that is spread evenly."""
    flat, order = depth.ravel(), _evenly_spread(*depth.shape)
    # Looked for in a part of the list that should hold them, and in all of it only where that does not.
    share = max(np.count_nonzero(flat), 1) / len(flat)
    some = order[: int(1.2 * most / share) + 100]
    chosen = some[flat[some] > 0]
    if len(chosen) < most and len(some) < len(order):
        chosen = order[flat[order] > 0]
    return chosen[:most]


def _neighbours_together(pixels: NDArray[np.int64], width: int) -> NDArray[np.int64]:
    """Return pixels, numbered row by row, with those between two of ``EVEN_AT`` sorted by bands of rows.

    Points that follow each other then ask for the same part of a model, which is in the cache by the second time.
    """
    v, u = np.divmod(pixels, width)
    places = (v // _BAND_PX) * width + u
    parts = np.split(np.arange(len(pixels)), [count for count in EVEN_AT if count < len(pixels)])
    return np.concatenate([pixels[part[np.argsort(places[part], kind="stable")]] for part in parts])


@lru_cache(maxsize=4)
def _evenly_spread(height: int, width: int) -> NDArray[np.int64]:
    """Return all pixels of an image, numbered row by row, in an order of which each beginning is spread evenly."""
    v, u = np.mgrid[:height, :width]
    # A rank-1 lattice: the pixels below any bound of this rank are spread evenly (Roberts' R2 sequence).
    return np.argsort(np.mod(u * 0.7548776662466927 + v * 0.5698402909980532, 1.0), axis=None, kind="stable")


@dataclass(frozen=True)
class DepthNoise:
    """The standard deviation of depth, σ(z) = ``constant`` + ``quadratic`` · z², metres."""

    constant: float
    quadratic: float

    def __call__(self, depth: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return σ at depths of any shape."""
        return self.constant + self.quadratic * np.asarray(depth, dtype=np.float64) ** 2


def _trimmed_deviation(values: NDArray[np.float64]) -> float:
    """Return the standard deviation that the smallest four fifths of normally distributed values tell of all."""
    squares = np.sort(values**2)[: max(int(0.8 * len(values)), 1)]
    # Of a standard normal distribution, cut off at the 80 % quantile of its size.
    return float(np.sqrt(squares.mean() / 0.43775))


def depth_noise(depth: NDArray[np.float32]) -> DepthNoise:
    """Tell the noise of a depth image (height, width), 0 = invalid, from itself.

    On a plane, depth along a row has no second difference but for its noise, which makes it √6 σ wide. The greatest
    fifth of them, where edges are, is left out; a median would not see the steps of a coarsely quantised depth. Noise
    that is alike in neighbouring pixels is not seen either way. Of a large image some rows tell enough.
    """
    depth = depth[:: -(-np.count_nonzero(depth) // _NOISE_PIXELS) or 1]
    left, middle, right = depth[:, :-2], depth[:, 1:-1], depth[:, 2:]
    valid = (left > 0) & (middle > 0) & (right > 0)
    if valid.sum() < _LEAST_PIXELS_A_BIN:
        return DepthNoise(0.0, 0.0)
    # Inverse depth is linear across a plane's pixels.
    z = middle[valid].astype(np.float64)
    bend = z**2 * (1 / left[valid].astype(np.float64) - 2 / z + 1 / right[valid].astype(np.float64))
    order = np.argsort(z)
    bins = [part for part in np.array_split(order, _NOISE_BINS) if len(part) >= _LEAST_PIXELS_A_BIN]
    bins = bins or [order]
    sigmas = np.array([_trimmed_deviation(bend[part]) / 6**0.5 for part in bins])
    squares = np.array([np.median(z[part]) ** 2 for part in bins])
    spread = squares - squares.mean()
    quadratic = float((spread @ sigmas) / (spread @ spread)) if len(bins) > 2 and np.ptp(squares) > 0.1 else 0.0
    quadratic = min(max(quadratic, 0.0), float((sigmas / squares).min()))
    return DepthNoise(float((sigmas - quadratic * squares).mean()), quadratic)
