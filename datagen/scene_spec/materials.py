"""What surfaces look like."""

from typing import Self

from pydantic import model_validator

from datagen.scene_spec.base import Color, Fraction, Spec
from datagen.scene_spec.textures import TextureSettings


class MaterialSettings(Spec):
    """An opaque surface of one ``color``, or with a ``texture``.

    ``coat`` is a layer of clear lacquer or glaze, ``sheen`` the soft edge light of cloth.
    """

    color: Color | None = None
    texture: TextureSettings | None = None
    roughness: Fraction = 0.5
    metallic: Fraction = 0.0
    coat: Fraction = 0.0
    sheen: Fraction = 0.0

    @model_validator(mode="after")
    def _has_one_source_of_colour(self) -> Self:
        if (self.color is None) == (self.texture is None):
            raise ValueError("give exactly one of color and texture")
        return self
