"""Sawn boards: year rings cut lengthwise, fibres, pores."""

from itertools import pairwise

import numpy as np

from datagen.textures.noise import fractal_noise, lattice_noise
from datagen.textures.picture import Field, Picture, mix, shade, smoothstep

Colors = tuple[tuple[float, float, float], ...]

RING_WIDTH = 0.07
"""Of a board's width."""


def wood(rng: np.random.Generator, size: tuple[int, int], colors: Colors, *, boards: int = 1) -> Picture:
    """Paint ``boards`` boards side by side, their grain along the width of the picture (``size``: width, height)."""
    width, height = size
    edges = np.rint(np.linspace(0, height, boards + 1)).astype(int)
    pieces = [_board(rng, (width, bottom - top), colors) for top, bottom in pairwise(edges)]
    color = np.concatenate([piece.color for piece in pieces])
    dullness = np.concatenate([piece.dullness for piece in pieces])
    if boards > 1:
        seam = _seams(height, edges)[:, None] * np.ones((1, width), np.float32)
        color, dullness = shade(color, 1 - 0.72 * seam), dullness + seam
    return Picture(color=color, dullness=np.clip(dullness, -1, 1))


def _board(rng: np.random.Generator, size: tuple[int, int], colors: Colors) -> Picture:
    """Cut a log along its axis: rings are circles about the pith, which runs below the board and slightly askew."""
    width, height = size
    along = np.linspace(0, 1, width, dtype=np.float32)[None, :]
    across = np.linspace(0, 1, height, dtype=np.float32)[:, None]
    pith_across = rng.uniform(0.2, 0.8) + 0.12 * lattice_noise(rng, (width, 1), (3, 1))
    depth = (
        rng.uniform(0.12, 0.5) + rng.uniform(-0.5, 0.5) * (along - 0.5) + 0.1 * lattice_noise(rng, (width, 1), (4, 1))
    )
    radius = np.hypot(across - pith_across, depth) + 0.05 * fractal_noise(rng, size, (5, 5), octaves=3)
    years = radius / RING_WIDTH
    year = years - np.floor(years)
    # Early wood darkens slowly into late wood, which ends sharply.
    late = smoothstep(0.25, 0.92, year) * (1 - smoothstep(0.93, 1.0, year))
    fibres = fractal_noise(rng, size, (6, height / 5), octaves=3, persistence=0.7)
    pores = smoothstep(0.42, 0.75, lattice_noise(rng, size, (width / 28, height / 2.5))) * (0.35 + 0.65 * (1 - late))
    tone = 1 + rng.uniform(-0.13, 0.10) + 0.06 * fractal_noise(rng, size, (3, 2), octaves=2)
    color: Field = mix(colors[0], colors[1], 0.72 * late + 0.16 * fibres + 0.08)
    color = shade(color, tone * (1 + 0.05 * fibres - 0.22 * pores))
    return Picture(color=color, dullness=0.5 * pores + 0.3 * fibres - 0.2 * late)


def _seams(height: int, edges: np.ndarray) -> Field:
    rows = np.arange(height)[:, None]
    distance = np.abs(rows + 0.5 - edges[None, :]).min(axis=1)
    return 1 - smoothstep(0.5, max(2.0, height / 420), distance)
