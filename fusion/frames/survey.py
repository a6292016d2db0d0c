"""A first look at the frames: the volume's bounds and the scale of what they show."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import Matrix

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

# All in one call that holds no lock: the dozens of small NumPy steps that it would take make decoding threads wait for
# each other. A coordinate in the world is z (r0 x + r1 y + r2) + t, with x and y the slopes of a corner's ray: its
# extremes over a tile's corners are those of r0 x and of r1 y, added. The median is that of every seventh pixel, found
# by its high byte and then by its low one.
_SURVEY_IN_CPP = """
    constexpr int TILE = 8, STRIDE = 7;
    const int height = steps.shape[0], width = steps.shape[1];
    const double fx = intrinsics[0], fy = intrinsics[1], cx = intrinsics[2], cy = intrinsics[3];
    const unsigned short *image = steps.data;
    double low[3], high[3];
    for (int axis = 0; axis < 3; ++axis) { low[axis] = 1e300; high[axis] = -1e300; }
    int farthest = 0;
    for (int v = 0; v < height; v += TILE) {
        const int bottom = v + TILE < height ? v + TILE : height;
        for (int u = 0; u < width; u += TILE) {
            const int right = u + TILE < width ? u + TILE : width;
            unsigned short least[TILE], most[TILE];
            for (int i = 0; i < TILE; ++i) { least[i] = 65535; most[i] = 0; }
            auto widen = [&](int i, unsigned short z) {
                const unsigned short wrapped = (unsigned short)(z - 1);  // invalid, 0, becomes the largest
                least[i] = wrapped < least[i] ? wrapped : least[i];
                most[i] = z > most[i] ? z : most[i];
            };
            for (int row = v; row < bottom; ++row) {
                const unsigned short *z = image + (size_t)row * width + u;
                if (right - u == TILE) {
                    for (int i = 0; i < TILE; ++i) widen(i, z[i]);
                } else {
                    for (int i = 0; i < right - u; ++i) widen(i, z[i]);
                }
            }
            int near = 65535, far = 0;
            for (int i = 0; i < TILE; ++i) {
                near = least[i] < near ? least[i] : near;
                far = most[i] > far ? most[i] : far;
            }
            if (far == 0) continue;
            near += 1;
            farthest = far > farthest ? far : farthest;
            const double x0 = (u - 0.5 - cx) / fx, x1 = (right - 0.5 - cx) / fx;
            const double y0 = (v - 0.5 - cy) / fy, y1 = (bottom - 0.5 - cy) / fy;
            for (int axis = 0; axis < 3; ++axis) {
                const double *r = rotation.data[axis];
                const bool rising_x = r[0] > 0.0, rising_y = r[1] > 0.0;
                const double first = r[0] * (rising_x ? x0 : x1) + r[1] * (rising_y ? y0 : y1) + r[2];
                const double last = r[0] * (rising_x ? x1 : x0) + r[1] * (rising_y ? y1 : y0) + r[2];
                const double lowest = first * (first < 0.0 ? far : near), highest = last * (last > 0.0 ? far : near);
                low[axis] = lowest < low[axis] ? lowest : low[axis];
                high[axis] = highest > high[axis] ? highest : high[axis];
            }
        }
    }
    unsigned long long squares = 0;
    const size_t count = (size_t)height * width;
    for (size_t i = 0; i < count; ++i) squares += (unsigned long long)image[i] * image[i];
    int by_high[256] = {0}, by_low[256] = {0}, valid = 0, before = 0, median_high = 0, median_low = 0;
    const size_t stride = farthest > 0 && count > 64 * STRIDE ? STRIDE : 1;
    for (size_t i = 0; i < count; i += stride) {
        by_high[image[i] >> 8] += image[i] > 0;
        valid += image[i] > 0;
    }
    while (median_high < 255 && before + by_high[median_high] <= valid / 2) before += by_high[median_high++];
    for (size_t i = 0; i < count; i += stride) by_low[image[i] & 255] += image[i] > 0 && image[i] >> 8 == median_high;
    while (median_low < 255 && before + by_low[median_low] <= valid / 2) before += by_low[median_low++];
    for (int axis = 0; axis < 3; ++axis) {
        findings.data[axis] = low[axis];
        findings.data[3 + axis] = high[axis];
    }
    findings.data[6] = farthest;
    findings.data[7] = valid > 0 ? 256 * median_high + median_low : farthest;
    findings.data[8] = (double)squares;
"""


@wp.func_native(_SURVEY_IN_CPP)
def survey_steps(
    steps: wp.array2d(dtype=wp.uint16), intrinsics: wp.vec4d, rotation: wp.mat33d, findings: wp.array(dtype=wp.float64)
) -> None:
    """Fill in the box's corners as seen from the camera, the farthest depth, the median, and the sum of squares."""


@wp.kernel
def _survey(
    steps: wp.array2d(dtype=wp.uint16),
    intrinsics: wp.vec4d,  # fx, fy, cx, cy
    rotation: wp.mat33d,  # world_from_camera
    findings: wp.array(dtype=wp.float64),
) -> None:
    survey_steps(steps, intrinsics, rotation, findings)


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
    findings = np.zeros(9)
    wp.launch(
        _survey,
        dim=1,
        inputs=[
            _shared(steps, wp.uint16),
            wp.vec4d(camera.fx, camera.fy, camera.cx, camera.cy),
            wp.mat33d(world_from_camera[:3, :3]),
        ],
        outputs=[_shared(findings, wp.float64)],
        device="cpu",
    )
    farthest, median, squares = findings[6:]
    seen = farthest > 0
    origin = world_from_camera[:3, 3]
    return FrameSurvey(
        low=origin + depth_scale * findings[:3] if seen else None,
        high=origin + depth_scale * findings[3:6] if seen else None,
        median_depth=depth_scale * float(median),
        farthest=depth_scale * float(farthest),
        surface_area=depth_scale**2 * float(squares) / (camera.fx * camera.fy),
    )


def load() -> None:
    """Load the kernel, to be done before threads survey together: each would compile it."""
    wp.load_module(__name__, device="cpu")


def _shared(array: NDArray, dtype: type) -> wp.array:
    return wp.array(array, dtype=dtype, device="cpu", copy=False)


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
