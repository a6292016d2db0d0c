"""Colour's offset from images of the same points, where depth has no edges to tell it."""

from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest
from ray_cast_recordings import record

from datagen.dataset_check.photo_consistency import View, measure_photo_consistency

SEED = 41  # an empty room with a chequered pattern: depth has hardly an edge


@lru_cache(maxsize=1)
def _room():
    return record(SEED, frames=24)


def _measure(move):
    clean = _room()
    dataset = clean.in_memory(None)
    frames = [dataset.frame(frame_id) for frame_id in dataset.frame_ids]
    views = [View(color=move(f.color), depth=f.depth, world_from_camera=f.world_from_camera) for f in frames]
    pairs = [*pairwise(views), *zip(views, views[3:], strict=False), *zip(views[6:], views, strict=False)]
    return measure_photo_consistency(pairs, dataset.camera, np.random.default_rng(0))


@pytest.mark.parametrize("offset", [(0, 0), (-7, 4), (1, -3)])
def test_the_offset_of_colour_is_found_in_a_room_without_edges(offset):
    found = _measure(lambda color: np.roll(color, offset, axis=(1, 0)))
    assert found.is_clear
    assert found.offset_px == offset


def test_colour_that_is_not_of_the_surface_tells_nothing():
    rng = np.random.default_rng(1)
    assert not _measure(lambda color: rng.integers(0, 255, color.shape, np.uint8)).is_clear


def test_colour_without_texture_tells_nothing():
    assert not _measure(lambda color: np.full_like(color, 90)).is_clear
