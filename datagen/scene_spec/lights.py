"""Lamps and the background."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from datagen.scene_spec.base import Color, Fraction, NotNegative, Positive, Spec, Vector

DEFAULT_LIGHT_SIZE = 0.1
DEFAULT_SUN_ANGLE_DEG = 0.5


class LightSettings(Spec):
    """A lamp at ``position``; a sun or an area light faces ``look_at`` (the origin where not given).

    ``power`` is watts, for a sun watts per square metre. ``size`` (0.1) is the side of an area light or the radius of
    a point light, ``angle_deg`` (0.5) the angle that a sun covers: larger is softer. A type has only what it uses.
    """

    type: Literal["sun", "point", "area"]
    position: Vector
    look_at: Vector | None = None
    color: Color = (1.0, 1.0, 1.0)
    power: NotNegative
    size: Positive | None = None
    angle_deg: Annotated[float, Field(ge=0, le=180)] | None = None

    @property
    def target(self) -> Vector:
        """The point that a sun or an area light faces."""
        return self.look_at if self.look_at is not None else (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _has_what_its_type_has(self) -> Self:
        for key in {"sun": ("size",), "point": ("look_at", "angle_deg"), "area": ("angle_deg",)}[self.type]:
            if getattr(self, key) is not None:
                raise ValueError(f"{key} has no meaning for a light of type {self.type}")
        if self.type != "point" and self.position == self.target:
            raise ValueError(f"position must differ from what is looked at, {list(self.target)}")
        return self


class SkySettings(Spec):
    """A painted sky: the world's colour overhead, ``horizon`` and ``ground``, and ``clouds`` from none to all over."""

    horizon: Color = (0.85, 0.89, 0.93)
    ground: Color = (0.45, 0.43, 0.40)
    clouds: Fraction = 0.3
    seed: int = Field(default=0, ge=0)


class WorldSettings(Spec):
    """The background, which lights the scene from all sides: one colour, or a ``sky``."""

    color: Color = (0.8, 0.8, 0.8)
    strength: NotNegative = 1.0
    sky: SkySettings | None = None
