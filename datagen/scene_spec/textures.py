"""Patterns that are painted by the program: nothing is downloaded, and a seed decides every detail."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from datagen.scene_spec.base import Color, Fraction, Positive, Spec

PATTERN_KEYS = {
    "wood": {"boards"},
    "tiles": {"tiles", "joint"},
    "fabric": {"threads"},
    "mottled": {"grain"},
    "print": {"text", "motif", "spine"},
}


class TextureSettings(Spec):
    """A pattern in ``colors``, first the one that covers most.

    - ``wood``: grain along u with rings and pores, side by side ``boards`` boards; colours: early wood, late wood.
    - ``tiles``: ``tiles`` [across, up] slabs, each its own shade, between joints of width ``joint`` (of a tile);
      colours: slab, vein, joint.
    - ``fabric``: ``threads`` [warp, weft] woven over and under; colours: warp, weft (then stripes).
    - ``mottled``: clouds and specks for plaster, glaze, leather or fruit, ``grain`` clouds across; colours: ground,
      clouds, specks.
    - ``print``: a cover or label with ``text`` (title, then smaller lines) and a ``motif``; colours: paper, ink, motif.
      ``spine`` is the spine's share of the width where it wraps around a book.

    The picture repeats every ``size`` [across, up] metres of the surface; without a size it is stretched over each part
    once: around a lathe, onto each side of a box, over back, spine and front of a book. ``pixels`` is its width.
    ``contrast`` weakens it; ``gloss`` is by how much the roughness varies with it.
    """

    pattern: Literal["wood", "tiles", "fabric", "mottled", "print"]
    colors: Annotated[tuple[Color, ...], Field(min_length=2, max_length=4)]
    size: tuple[Positive, Positive] | None = None
    pixels: int = Field(default=1024, ge=64, le=8192)
    aspect: Positive = 1.0
    seed: int = Field(default=0, ge=0)
    contrast: Fraction = 1.0
    gloss: Fraction = 0.3
    boards: Annotated[int, Field(ge=1, le=64)] | None = None
    tiles: tuple[Annotated[int, Field(ge=1, le=64)], Annotated[int, Field(ge=1, le=64)]] | None = None
    joint: Annotated[float, Field(gt=0, lt=0.5)] | None = None
    threads: tuple[Annotated[int, Field(ge=1, le=2048)], Annotated[int, Field(ge=1, le=2048)]] | None = None
    grain: Annotated[int, Field(ge=1, le=256)] | None = None
    text: tuple[str, ...] | None = None
    motif: Literal["sun", "waves", "leaves", "bands"] | None = None
    spine: Annotated[float, Field(ge=0, lt=0.5)] | None = None

    @model_validator(mode="after")
    def _has_what_its_pattern_has(self) -> Self:
        for pattern, keys in PATTERN_KEYS.items():
            for key in sorted(keys):
                if pattern != self.pattern and getattr(self, key) is not None:
                    raise ValueError(f"{key} has no meaning for the pattern {self.pattern}")
        return self

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the picture in pixels: of the shape that ``size``, or else ``aspect``, gives it."""
        aspect = self.size[0] / self.size[1] if self.size is not None else self.aspect
        return self.pixels, max(16, round(self.pixels / aspect))
