"""A sky for all directions: a gradient, haze at the horizon, soft clouds."""

import numpy as np
from numpy.typing import NDArray

from datagen.color import linear_from_srgb
from datagen.textures.noise import fractal_noise
from datagen.textures.picture import mix, shade, smoothstep

Rgb = tuple[float, float, float]
CLOUD = (1.0, 0.97, 0.93)


def sky(
    rng: np.random.Generator, width: int, *, zenith: Rgb, horizon: Rgb, ground: Rgb, clouds: float
) -> NDArray[np.float32]:
    """Return linear light (width / 2, width, 3) by direction, equirectangular, first row upwards; colours are sRGB."""
    height = width // 2
    elevation = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    rise = np.sin(elevation).astype(np.float32)[:, None] + np.zeros((1, width), np.float32)
    color = mix(horizon, zenith, np.clip(rise, 0, 1) ** 0.55)
    puffs = fractal_noise(rng, (width, height), (10, 14), octaves=6, persistence=0.55)
    cover = smoothstep(0.45 - 0.6 * clouds, 0.95 - 0.6 * clouds, puffs) * smoothstep(0.0, 0.25, rise)
    color = mix(color, np.broadcast_to(np.asarray(CLOUD, np.float32), color.shape), 0.8 * cover * min(1.0, 2 * clouds))
    # Land in the distance: darker and lighter patches, hazier towards the horizon.
    land = mix(ground, horizon, np.clip(0.55 + 2.2 * rise, 0, 0.55))
    patches = fractal_noise(rng, (width, height), (28, 20), octaves=4)
    color = mix(shade(land, 1 + 0.35 * patches), color, smoothstep(-0.012, 0.0, rise + 0.008 * patches))
    return linear_from_srgb(color).astype(np.float32)
