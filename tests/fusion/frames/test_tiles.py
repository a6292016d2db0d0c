"""What is found out about tiles of pixels, against NumPy: for images that tiles and vectors fit into, and others."""

import numpy as np
import pytest

from datagen.camera import PinholeCamera
from fusion.frames.color_confidence import judge_colors
from fusion.frames.depth_tiles import depth_tiles
from fusion.frames.frame_batch import FrameUploader

STEP, SCALE = 0.05, 1e-3
SIZES = [(333, 21), (45, 37), (640, 16), (8, 8), (3, 2), (1, 1)]


def images(width, height, rng):
    """Surfaces at two depths, with slopes, stray pixels and holes; in steps."""
    v, u = np.mgrid[:height, :width]
    depth = 1.2 + 0.002 * u - 0.001 * v + 0.3 * (u > width // 3) * (v > height // 4)
    depth[rng.random(depth.shape) < 0.01] += 0.4
    depth[rng.random(depth.shape) < 0.02] = 0
    return np.stack([np.rint(depth / SCALE).astype(np.uint16), np.zeros((height, width), np.uint16)])


def uploaded(steps, device, *, in_steps):
    frames, height, width = steps.shape
    camera = PinholeCamera(width=width, height=height, fx=300.0, fy=300.0, cx=width / 2, cy=height / 2)
    upload = FrameUploader(camera, device=device, capacity=frames, depth_scale=SCALE if in_steps else None)
    return upload(steps if in_steps else list(steps.astype(np.float32) * np.float32(SCALE)), [np.eye(4)] * frames)


@pytest.mark.parametrize("in_steps", [True, False])
@pytest.mark.parametrize(("width", "height"), SIZES)
def test_a_tiles_ranges_are_those_of_its_near_and_of_its_far_pixels(device, width, height, in_steps):
    steps = images(width, height, np.random.default_rng(0))
    batch = uploaded(steps, device, in_steps=in_steps)
    ranges = depth_tiles(batch, split_beyond=STEP).ranges.numpy()
    split = 0
    for frame, row, column in np.ndindex(ranges.shape[:3]):
        tile = steps[frame, 8 * row : 8 * row + 8, 8 * column : 8 * column + 8]
        z = np.sort(tile[tile > 0]) * SCALE
        near_begin, near_end, far_begin, far_end = ranges[frame, row, column]
        if len(z) == 0:
            assert near_begin > 1e38
            assert far_begin > 1e38
        elif z[-1] - z[0] <= STEP:
            np.testing.assert_allclose([near_begin, near_end], [z[0], z[-1]], rtol=1e-6)
            assert far_begin > 1e38
        else:
            middle = (z[0] + z[-1]) / 2
            near, far = z[z <= middle + 1e-9], z[z > middle + 1e-9]
            expected = [near[0], near[-1], far[0], far[-1]]
            np.testing.assert_allclose([near_begin, near_end, far_begin, far_end], expected, rtol=1e-6)
            split += 1
    assert split > 0 or width * height < 300


@pytest.mark.parametrize("in_steps", [True, False])
@pytest.mark.parametrize(("width", "height"), SIZES)
def test_colours_are_trusted_where_no_pixel_around_ends_or_jumps(device, width, height, in_steps):
    steps = images(width, height, np.random.default_rng(1))
    batch = uploaded(steps, device, in_steps=in_steps)
    # Half a step beside any sum of steps, so that rounding decides nothing.
    judge_colors(batch, step=STEP + SCALE / 2)
    padded = np.pad(steps.astype(int), ((0, 0), (1, 1), (1, 1)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (1, 3, 3))[..., 0, :, :]
    low, high = windows.min((-1, -2)), windows.max((-1, -2))
    expected = (low > 0) & (high - low <= STEP / SCALE + 0.5)
    rows, columns = -(-height // 8), -(-width // 8)
    tiles = np.unpackbits(batch.confidence.numpy().reshape(2, rows, columns, 8), axis=-1, bitorder="little")
    trusted = tiles.reshape(2, rows, columns, 8, 8).transpose(0, 1, 3, 2, 4).reshape(2, 8 * rows, 8 * columns)
    np.testing.assert_array_equal(trusted[:, :height, :width], expected)
    assert expected.any() or width * height < 50
