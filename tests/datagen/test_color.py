import numpy as np
import pytest

from datagen.color import linear_from_srgb, srgb8_from_linear, srgb_from_linear


def test_every_8_bit_value_survives_linear_light():
    steps = np.arange(256)
    np.testing.assert_array_equal(srgb8_from_linear(linear_from_srgb(steps / 255)), steps)


def test_the_standards_own_points():
    assert srgb_from_linear(0.0031308) == pytest.approx(0.04045, abs=1e-5)
    assert srgb_from_linear(0.18) == pytest.approx(0.4614, abs=1e-4)


def test_light_beyond_white_clips():
    np.testing.assert_array_equal(srgb8_from_linear([-1.0, 7.0]), [0, 255])
