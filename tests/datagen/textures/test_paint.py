"""Painted pictures: what a seed decides, and what the declared colours and numbers mean."""

import json

import numpy as np
import pytest

from datagen.color import linear_from_srgb
from datagen.scene_spec.textures import TextureSettings
from datagen.textures.noise import fractal_noise, lattice_noise
from datagen.textures.paint import paint
from datagen.textures.sky import sky

PATTERNS = ("wood", "tiles", "fabric", "mottled", "print")


def settings(pattern, **more):
    content = {"pattern": pattern, "colors": ["#d0a070", "#905030"], "pixels": 128} | more
    return TextureSettings.model_validate_json(json.dumps(content))


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_seed_decides_a_picture(pattern):
    first, again, other = (paint(settings(pattern, seed=seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.color, again.color)
    np.testing.assert_array_equal(first.dullness, again.dullness)
    assert np.abs(first.color - other.color).max() > 0.01


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_picture_has_its_size_and_keeps_to_its_colours(pattern):
    picture = paint(settings(pattern, size=[2.0, 1.0]))
    assert picture.color.shape == (64, 128, 3)
    assert picture.dullness.shape == (64, 128)
    assert 0 <= picture.color.min() <= picture.color.max() <= 1
    assert -1 <= picture.dullness.min() <= picture.dullness.max() <= 1
    low, high = np.array([0x90, 0x50, 0x30]) / 255, np.array([0xD0, 0xA0, 0x70]) / 255
    mean = picture.color.mean(axis=(0, 1))
    assert (mean > 0.6 * low).all()
    assert (mean < 1.1 * high).all()


@pytest.mark.parametrize("pattern", PATTERNS)
def test_contrast_takes_the_picture_to_its_first_colour(pattern):
    first = np.array([0xD0, 0xA0, 0x70]) / 255
    strong, weak, none = (paint(settings(pattern, contrast=contrast)).color for contrast in (1.0, 0.5, 0.0))
    np.testing.assert_allclose(weak, (strong + first) / 2, atol=1e-6)
    np.testing.assert_allclose(none, np.broadcast_to(first, none.shape), atol=1e-6)


@pytest.mark.parametrize("noise", [lattice_noise, fractal_noise])
def test_noise_repeats_at_the_borders(noise):
    values = noise(np.random.default_rng(3), (256, 128), (8, 4))
    for axis in (0, 1):
        inside = np.abs(np.diff(values, axis=axis)).max()
        seam = np.abs(np.take(values, 0, axis=axis) - np.take(values, -1, axis=axis)).max()
        assert seam <= 1.2 * inside


def test_wood_runs_along_the_picture_and_has_a_seam_between_boards():
    picture = paint(settings("wood", pixels=512, boards=2, seed=4)).color.mean(axis=-1)
    board = picture[40:216]
    assert np.abs(np.diff(board, axis=1)).mean() < 0.5 * np.abs(np.diff(board, axis=0)).mean()
    assert picture[254:258].mean() < 0.7 * board.mean()


def test_tiles_are_as_many_as_declared_with_joints_of_the_third_colour():
    picture = paint(settings("tiles", pixels=400, tiles=[4, 4], joint=0.1, colors=["#d0d0d0", "#c0c0c0", "#ff0000"]))
    red = picture.color[..., 0] - picture.color[..., 1] > 0.5
    rows = red.mean(axis=1) > 0.9
    assert np.count_nonzero(np.diff(rows.astype(int)) == 1) + rows[0] in (4, 5)
    middle = red[50]
    assert np.count_nonzero(np.diff(middle.astype(int)) == 1) + middle[0] in (4, 5)


def test_a_label_bears_its_words_in_ink():
    bare, lettered = (paint(settings("print", pixels=512, **more)) for more in ({}, {"text": ["TEA", "black"]}))
    ink = np.array([0x90, 0x50, 0x30]) / 255
    is_ink = np.abs(lettered.color - ink).max(axis=-1) < 0.08
    inside = np.zeros_like(is_ink)
    inside[60:-60, 60:-60] = True
    assert not (np.abs(bare.color - ink).max(axis=-1) < 0.08)[inside].any()
    assert 0.03 < is_ink[inside].mean() < 0.5


def test_a_sky_goes_from_its_zenith_to_its_horizon_over_the_ground():
    colors = {"zenith": (0.2, 0.4, 0.8), "horizon": (0.9, 0.9, 0.9), "ground": (0.3, 0.3, 0.2)}
    light = sky(np.random.default_rng(0), 1024, clouds=0.0, **colors)
    assert light.shape == (512, 1024, 3)
    np.testing.assert_allclose(light[0].mean(axis=0), linear_from_srgb(colors["zenith"]), atol=0.02)
    np.testing.assert_allclose(light[253].mean(axis=0), linear_from_srgb(colors["horizon"]), atol=0.15)
    assert light[-1].mean() < 0.5 * light[253].mean()
    cloudy = sky(np.random.default_rng(0), 1024, clouds=1.0, **colors)
    assert cloudy[40].mean() > 1.3 * light[40].mean()
