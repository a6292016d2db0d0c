"""Tiles, cloth, and mottled surfaces."""

import numpy as np

from datagen.textures.noise import fractal_noise, lattice_noise
from datagen.textures.picture import Picture, mix, shade, smoothstep

Colors = tuple[tuple[float, float, float], ...]


def tiles(
    rng: np.random.Generator,
    size: tuple[int, int],
    colors: Colors,
    *,
    count: tuple[int, int] = (4, 4),
    joint: float = 0.02,
) -> Picture:
    """Paint ``count`` [across, up] stone slabs, every other row half a slab on; ``joint`` is a share of a slab."""
    width, height = size
    rows = np.repeat(np.arange(count[1]), -(-height // count[1]))[:height]
    up = (np.arange(height) + 0.5) / height * count[1]
    across = (np.arange(width) + 0.5)[None, :] / width * count[0] + 0.5 * (np.floor(up)[:, None] % 2)
    column = np.floor(across).astype(int) % count[0]
    row = np.floor(up).astype(int)[:, None] + np.zeros_like(column)
    wobble = 0.25 * joint * fractal_noise(rng, size, (count[0] * 5, count[1] * 5), octaves=2)
    from_side = np.minimum(across % 1, 1 - across % 1)
    slab_aspect = (width / count[0]) / (height / count[1])
    from_end = np.minimum(up % 1, 1 - up % 1)[:, None] / slab_aspect
    inside = smoothstep(0.4 * joint, 0.75 * joint, np.minimum(from_side, from_end) + wobble)
    worn = smoothstep(0.5 * joint, 3.5 * joint, np.minimum(from_side, from_end))
    tone = rng.uniform(0.86, 1.08, (rows.max() + 1, count[0])).astype(np.float32)[row, column]
    hue = rng.uniform(0, 0.5, (rows.max() + 1, count[0])).astype(np.float32)[row, column]
    clouds = fractal_noise(rng, size, (count[0] * 1.5, count[1] * 1.5), octaves=5, persistence=0.6)
    slab = mix(colors[0], colors[1], hue * 0.6 + 0.45 * clouds + 0.15)
    slab = shade(slab, tone * (0.93 + 0.07 * worn) * (1 + 0.08 * clouds))
    ground = np.asarray(colors[2] if len(colors) > 2 else colors[1], np.float32)
    dullness = np.clip(1 - inside + 0.5 * clouds, -1, 1)
    return Picture(color=mix(np.broadcast_to(ground, slab.shape), slab, inside), dullness=dullness)


def fabric(
    rng: np.random.Generator, size: tuple[int, int], colors: Colors, *, threads: tuple[int, int] = (64, 64)
) -> Picture:
    """Paint a plain weave of ``threads`` [warp, weft]; a third colour makes stripes near two borders of the warp."""
    width, height = size
    across = (np.arange(width) + 0.5)[None, :] / width * threads[0]
    up = (np.arange(height) + 0.5)[:, None] / height * threads[1]
    over = ((np.floor(across) + np.floor(up)) % 2).astype(np.float32)
    warp = rng.uniform(0.9, 1.06, threads[0]).astype(np.float32)[np.floor(across).astype(int) % threads[0]]
    weft = rng.uniform(0.9, 1.06, threads[1]).astype(np.float32)[np.floor(up).astype(int) % threads[1]]
    round_warp = 1 - (2 * (across % 1) - 1) ** 2
    round_weft = 1 - (2 * (up % 1) - 1) ** 2
    height_map = over * round_warp + (1 - over) * round_weft
    color = mix(colors[0], colors[1], 1 - over)
    if len(colors) > 2:
        place = np.abs((np.arange(width) + 0.5)[None, :] / width - 0.5)
        stripe = ((place > 0.36) & (place < 0.41) | (place > 0.43) & (place < 0.445)).astype(np.float32)
        color = mix(color, np.broadcast_to(np.asarray(colors[2], np.float32), color.shape), 0.85 * stripe + 0 * up)
    wear = 1 + 0.06 * fractal_noise(rng, size, (6, 6), octaves=3)
    color = shade(color, (0.74 + 0.26 * height_map) * (over * warp + (1 - over) * weft) * wear)
    return Picture(color=color, dullness=(0.5 - height_map).astype(np.float32))


def mottled(rng: np.random.Generator, size: tuple[int, int], colors: Colors, *, grain: int = 6) -> Picture:
    """Paint clouds, ``grain`` of them across, and specks where there is a third colour."""
    width, height = size
    cells = (grain, max(1.0, grain * height / width))
    clouds = fractal_noise(rng, size, cells, octaves=5, persistence=0.6)
    color = shade(mix(colors[0], colors[1], smoothstep(-0.35, 0.6, clouds)), 1 + 0.05 * clouds)
    specks = np.zeros_like(clouds)
    if len(colors) > 2:
        fine = lattice_noise(rng, size, (cells[0] * 16, cells[1] * 16))
        coarse = lattice_noise(rng, size, (cells[0] * 7, cells[1] * 7))
        specks = np.maximum(smoothstep(0.72, 0.9, fine), smoothstep(0.8, 0.93, coarse))
        color = mix(color, np.broadcast_to(np.asarray(colors[2], np.float32), color.shape), 0.8 * specks)
    return Picture(color=color, dullness=np.clip(clouds + specks, -1, 1))
