import numpy as np
import pytest

from datagen.dataset_check.depth_noise import measure_depth_noise
from datagen.dataset_check.views import inverse_depth, smooth_pixels


def _plane(noise_inverse_depth, step, slope=0.002):
    v, u = np.mgrid[:240, :320]
    nearness = 0.5 + slope * (u - 160) / 10 + 0.001 * (v - 120) / 10
    nearness = nearness + np.random.default_rng(0).normal(size=nearness.shape) * noise_inverse_depth
    depth = np.rint(1 / nearness / step) * step
    return depth.astype(np.float32)


@pytest.mark.parametrize("sigma", [0.0005, 0.002])
def test_noise_on_a_plane_is_measured(sigma):
    depth = _plane(sigma, 1e-5)
    noise = measure_depth_noise(inverse_depth(depth)[None], smooth_pixels(depth)[None], depth_scale=1e-5)
    assert noise.inverse_depth_sigma == pytest.approx(sigma, rel=0.05)
    assert noise.sigma(np.array(2.0)) == pytest.approx(4 * sigma, rel=0.05)


def test_a_plane_without_noise_has_that_of_its_steps_alone():
    depth = _plane(0, 1e-3)
    noise = measure_depth_noise(inverse_depth(depth)[None], smooth_pixels(depth)[None], depth_scale=1e-3)
    assert 1e-3 / np.sqrt(12) <= noise.sigma(np.array(2.0)) < 1.5e-3
