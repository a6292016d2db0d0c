"""Lamps and the background."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from datagen.scene_spec.base import Color, NotNegative, Positive, Spec, Vector

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


class WorldSettings(Spec):
    """The background, which lights the scene from all sides."""

    color: Color = (0.8, 0.8, 0.8)
    strength: NotNegative = 1.0
