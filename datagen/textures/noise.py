"""Smooth noise that repeats at the picture's borders."""

import cv2
import numpy as np

from datagen.textures.picture import Field


def lattice_noise(rng: np.random.Generator, size: tuple[int, int], cells: tuple[float, float]) -> Field:
    """Return noise (height, width) between −1 and 1: random values on ``cells`` [across, up], smoothly between them."""
    width, height = size
    columns, rows = (max(1, min(round(count), pixels)) for count, pixels in zip(cells, size, strict=True))
    values = rng.uniform(-1, 1, (rows, columns)).astype(np.float32)
    margin = 3
    padded = np.pad(values, margin, mode="wrap")
    # Positions of pixels in the padded lattice; the picture's right border meets its left.
    across = ((np.arange(width) + 0.5) / width * columns + margin - 0.5).astype(np.float32)
    up = ((np.arange(height) + 0.5) / height * rows + margin - 0.5).astype(np.float32)
    columns_at, rows_at = np.meshgrid(across, up)
    return cv2.remap(padded, columns_at, rows_at, interpolation=cv2.INTER_CUBIC).astype(np.float32)


def fractal_noise(
    rng: np.random.Generator,
    size: tuple[int, int],
    cells: tuple[float, float],
    *,
    octaves: int = 4,
    persistence: float = 0.5,
) -> Field:
    """Return lattice noise summed over ``octaves``, each twice as fine and ``persistence`` times as strong."""
    total = np.zeros(size[::-1], np.float32)
    weight = 1.0
    for octave in range(octaves):
        total += weight * lattice_noise(rng, size, (cells[0] * 2**octave, cells[1] * 2**octave))
        weight *= persistence
    return total / np.float32(sum(persistence**octave for octave in range(octaves)))
