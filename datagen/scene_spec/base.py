"""The types that all parts of a scene file are made of."""

import re
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field


class Spec(BaseModel):
    """A part of a scene file: frozen, without unknown keys, numbers finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


def _color_from_hex(value: Any) -> Any:
    if isinstance(value, str):
        if not re.fullmatch(r"#[0-9a-fA-F]{6}", value):
            raise ValueError('expected "#RRGGBB" or three numbers from 0 to 1')
        return tuple(int(value[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return tuple(value) if isinstance(value, list) else value


def _on_each_axis(value: Any) -> Any:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return (value, value, value)
    return tuple(value) if isinstance(value, list) else value


Fraction = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Vector = tuple[float, float, float]
Color = Annotated[tuple[Fraction, Fraction, Fraction], BeforeValidator(_color_from_hex)]
Scale = Annotated[tuple[Positive, Positive, Positive], BeforeValidator(_on_each_axis)]
Pixels = Annotated[int, Field(ge=1, le=16384)]
Name = Annotated[str, Field(min_length=1, max_length=63)]
