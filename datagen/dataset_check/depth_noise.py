"""How noisy depth is, measured on the images themselves."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LEAST_RELATIVE = 1e-5
"""Nobody's depth is better than this share of itself: float32 files, rays that graze a triangle's edge."""


@dataclass(frozen=True, kw_only=True)
class DepthNoise:
    """Standard deviation of depth: rounding to steps, and noise that is even in inverse depth (as in stereo).

    ``inverse_depth_sigma`` is in 1/metre, ``step`` in metres; both as the dataset has its depth.
    """

    step: float
    inverse_depth_sigma: float

    def sigma(self, depth: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the standard deviation in metres at ``depth`` in metres."""
        z = np.asarray(depth, dtype=np.float64)
        noise = self.inverse_depth_sigma * z * z
        return np.sqrt(noise * noise + self.step**2 / 12 + (LEAST_RELATIVE * z) ** 2)


def measure_depth_noise(
    inverse_depths: NDArray[np.float32], smooth: NDArray[np.bool_], *, depth_scale: float
) -> DepthNoise:
    """Measure the noise from second differences of inverse depth along rows, which planes have none of.

    ``inverse_depths`` and ``smooth`` are (m, H, W). On curved surfaces this is somewhat too large, never too small.
    The median of absolute differences is used: edges do not count. Noise that neighbours share is not seen.
    """
    triple = smooth[:, :, 2:] & smooth[:, :, 1:-1] & smooth[:, :, :-2]
    second = inverse_depths[:, :, 2:] - 2 * inverse_depths[:, :, 1:-1] + inverse_depths[:, :, :-2]
    values = second[triple]
    sigma = float(np.median(np.abs(values))) * 1.4826 / np.sqrt(6) if values.size else 0.0
    return DepthNoise(step=depth_scale, inverse_depth_sigma=sigma)
