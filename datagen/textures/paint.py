"""The picture of a declared texture."""

from typing import Any

import numpy as np

from datagen.scene_spec.textures import TextureSettings
from datagen.textures.picture import Picture, average, mix
from datagen.textures.printed import printed
from datagen.textures.surfaces import fabric, mottled, tiles
from datagen.textures.wood import wood

PATTERNS: dict[str, Any] = {"wood": wood, "tiles": tiles, "fabric": fabric, "mottled": mottled, "print": printed}
KEYWORDS = {
    "wood": {"boards": "boards"},
    "tiles": {"tiles": "count", "joint": "joint"},
    "fabric": {"threads": "threads"},
    "mottled": {"grain": "grain"},
    "print": {"text": "text", "motif": "motif", "spine": "spine"},
}


def paint(settings: TextureSettings) -> Picture:
    """Paint what is declared; its seed decides every detail."""
    options = {
        keyword: value
        for key, keyword in KEYWORDS[settings.pattern].items()
        if (value := getattr(settings, key)) is not None
    }
    rng = np.random.default_rng(settings.seed)
    picture: Picture = PATTERNS[settings.pattern](rng, settings.image_size, settings.colors, **options)
    if settings.contrast == 1:
        return picture
    middle = np.broadcast_to(average(settings.colors[:1]), picture.color.shape)
    share = np.full(picture.color.shape[:2], settings.contrast, np.float32)
    return Picture(color=mix(middle, picture.color, share), dullness=picture.dullness)
