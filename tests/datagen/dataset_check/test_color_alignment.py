import cv2
import numpy as np
import pytest
from ray_cast_recordings import record

from datagen.dataset_check.color_alignment import measure_color_alignment


def _frames(*, count=6, size=(160, 120), texture=0.0):
    """Discs before a wall, in colours of their own."""
    rng = np.random.default_rng(3)
    frames = []
    for _ in range(count):
        color = np.full((size[1], size[0], 3), 90, np.uint8)
        depth = np.full((size[1], size[0]), 3.0, np.float32)
        for _ in range(5):
            centre = (int(rng.integers(25, size[0] - 25)), int(rng.integers(25, size[1] - 25)))
            radius, near = int(rng.integers(8, 18)), float(rng.uniform(1, 2))
            cv2.circle(color, centre, radius, rng.integers(0, 255, 3).tolist(), -1)
            cv2.circle(depth, centre, radius, near, -1)
        color = np.clip(color + texture * rng.normal(size=color.shape), 0, 255).astype(np.uint8)
        frames.append((color, depth))
    return frames


def _moved(image, x, y, zoom=1.0):
    height, width = image.shape[:2]
    cx, cy = (width - 1) / 2, (height - 1) / 2
    matrix = np.array([[zoom, 0, cx * (1 - zoom) + x], [0, zoom, cy * (1 - zoom) + y]])
    return cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)


@pytest.mark.parametrize("offset", [(0, 0), (3, 0), (-2, 5), (8, -7)])
@pytest.mark.parametrize("texture", [0.0, 20.0])
def test_a_known_offset_is_measured(offset, texture):
    frames = [(_moved(color, *offset), depth) for color, depth in _frames(texture=texture)]
    alignment = measure_color_alignment(frames, np.random.default_rng(0))
    assert alignment.is_clear
    np.testing.assert_allclose(alignment.offset_px, offset, atol=0.3)
    assert (alignment.significance > 4) == (offset != (0, 0))


def test_an_offset_of_half_a_pixel_is_measured():
    frames = [(_moved(color, 2.5, 0), depth) for color, depth in _frames(count=12)]
    alignment = measure_color_alignment(frames, np.random.default_rng(0))
    np.testing.assert_allclose(alignment.offset_px, (2.5, 0), atol=0.3)


@pytest.mark.parametrize("lost", [1, 2])
def test_pixels_that_depth_loses_at_its_edges_are_no_offset(lost):
    kernel = np.ones((2 * lost + 1,) * 2, np.uint8)
    frames = []
    for color, depth in _frames(count=12):
        edge = cv2.dilate(depth, kernel) != cv2.erode(depth, kernel)
        frames.append((color, np.where(edge, 0, depth)))
    alignment = measure_color_alignment(frames, np.random.default_rng(0))
    assert alignment.is_clear
    np.testing.assert_allclose(alignment.offset_px, (0, 0), atol=0.3)
    assert alignment.lost_px >= lost  # the square takes more off slanting edges


def test_another_focal_length_of_colour_is_told_from_an_offset():
    frames = [(_moved(color, 4, -3, zoom=0.9), depth) for color, depth in _frames(count=12, size=(320, 240))]
    alignment = measure_color_alignment(frames, np.random.default_rng(0))
    assert alignment.is_clear
    assert alignment.zoom == pytest.approx(0.9, abs=0.021)
    np.testing.assert_allclose(alignment.offset_px, (4, -3), atol=1)


def test_colour_that_shows_nothing_of_depth_tells_nothing():
    rng = np.random.default_rng(1)
    frames = [(rng.integers(0, 255, color.shape, np.uint8), depth) for color, depth in _frames()]
    assert not measure_color_alignment(frames, rng).is_clear


def test_depth_without_edges_tells_nothing():
    flat = [(color, np.full_like(depth, 2)) for color, depth in _frames()]
    assert measure_color_alignment(flat, np.random.default_rng(0)) is None


@pytest.mark.parametrize("offset", [(0, 0), (-1, -5), (6, 3)])
def test_the_corners_of_an_empty_room_tell_the_offset(offset):
    room = record(101, frames=8)  # plain walls and a floor: nothing stands before anything
    images = [
        (np.roll(color, offset, axis=(1, 0)), depth) for color, depth in zip(room.colors, room.depths, strict=True)
    ]
    alignment = measure_color_alignment(images, np.random.default_rng(0))
    assert alignment.is_clear
    np.testing.assert_allclose(alignment.offset_px, offset, atol=0.3)
