import numpy as np
import pytest

from datagen.errors import InputError
from datagen.preview.depth_colors import INVALID_COLOR, MOST_TICKS, DepthScale, colored_depth, depth_scale, scale_strip


def luminance(colors):
    return colors.astype(float) @ (0.2126, 0.7152, 0.0722)


def test_nearer_is_brighter_all_along_the_scale():
    depth = np.linspace(1, 3, 200, dtype=np.float32)[None, :]
    brightness = luminance(colored_depth(depth, DepthScale(nearest=1.0, farthest=3.0)))[0]
    assert (np.diff(brightness) <= 1).all()  # 8-bit colours go in steps
    assert brightness[0] > brightness[-1] + 150


def test_pixels_without_depth_are_grey_and_nothing_else_is():
    depth = np.array([[0.0, 0.5, 1.0, 2.0, 3.0, 9.0]], np.float32)
    colors = colored_depth(depth, DepthScale(nearest=1.0, farthest=3.0))[0]
    grey = (colors == INVALID_COLOR).all(axis=-1)
    np.testing.assert_array_equal(grey, [True, False, False, False, False, False])
    np.testing.assert_array_equal(colors[1], colors[2])  # beyond the ends colours stay
    np.testing.assert_array_equal(colors[5], colors[4])


@pytest.mark.parametrize(("nearest", "farthest"), [(0.75, 1.09), (0.3, 12.0), (1.0, 1.002), (0.4, 3.1), (2, 150)])
def test_ticks_are_few_round_and_within_the_scale(nearest, farthest):
    scale = DepthScale(nearest=nearest, farthest=farthest)
    assert 2 <= len(scale.ticks) <= MOST_TICKS
    assert all(nearest - 1e-9 <= tick <= farthest + 1e-9 for tick in scale.ticks)
    assert len({scale.label(tick) for tick in scale.ticks}) == len(scale.ticks)
    for tick in scale.ticks:
        assert float(scale.label(tick)) == pytest.approx(tick, abs=1e-9)


def test_the_scale_spans_what_is_seen_but_for_strays():
    image = np.random.default_rng(0).uniform(1, 2, (100, 100)).astype(np.float32)
    image[0, :20] = 50
    image[1] = 0
    scale = depth_scale([image], source="x")
    assert scale.nearest == pytest.approx(1, abs=0.02)
    assert scale.farthest == pytest.approx(2, abs=0.02)


def test_a_wall_has_a_scale_too():
    scale = depth_scale([np.full((4, 4), 2.0, np.float32)], source="x")
    assert scale.nearest < 2 < scale.farthest


def test_no_depth_at_all_is_said():
    with pytest.raises(InputError, match="kitchen: 1 depth images were read and none has a valid pixel"):
        depth_scale([np.zeros((4, 4), np.float32)], source="kitchen")


def test_the_strip_is_what_depth_looks_like():
    strip = scale_strip(101, 3)
    depth = np.linspace(1, 2, 101, dtype=np.float32)[None, :]
    expected = colored_depth(depth, DepthScale(nearest=1.0, farthest=2.0))
    assert np.abs(strip[1].astype(int) - expected[0]).max() <= 3
