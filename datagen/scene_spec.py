"""Scene files: what is rendered and how the camera moves, declared in TOML and checked before Blender starts.

Lengths are metres, angles degrees, the world's z axis points up. Colours are sRGB, as colour pickers show them:
``"#RRGGBB"`` or three numbers from 0 to 1.
"""

import re
from itertools import pairwise
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, field_validator, model_validator


class _Spec(BaseModel):
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


DEFAULT_LIGHT_SIZE = 0.1
DEFAULT_SUN_ANGLE_DEG = 0.5

Fraction = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Vector = tuple[float, float, float]
Color = Annotated[tuple[Fraction, Fraction, Fraction], BeforeValidator(_color_from_hex)]
Scale = Annotated[tuple[Positive, Positive, Positive], BeforeValidator(_on_each_axis)]
Pixels = Annotated[int, Field(ge=1, le=16384)]
Name = Annotated[str, Field(min_length=1, max_length=63)]


class RenderSettings(_Spec):
    """How many frames, how large and how carefully.

    ``samples`` is Cycles' samples a pixel and ``seed`` decides their noise; ``depth_scale`` is metres per step of the
    16-bit depth images, so 65534 steps must reach the farthest surface; ``bounces`` limits light paths; ``denoise``
    runs OpenImageDenoise in its fast mode on the colours, never on depth.
    """

    frames: int = Field(default=60, ge=1, le=1_000_000)
    size: tuple[Pixels, Pixels] = (640, 480)
    samples: int = Field(default=16, ge=1, le=65536)
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    depth_scale: Positive = 0.0001
    frames_per_second: Positive = 30.0
    bounces: int = Field(default=4, ge=0, le=64)
    denoise: bool = True


class CameraSettings(_Spec):
    """The lens: focal length and the width of the sensor it projects on; surfaces outside the clip range are not seen.

    The sensor's width spans the image's width, whichever side of the image is longer.
    """

    focal_length_mm: float = Field(default=50.0, ge=1, le=5000)
    sensor_width_mm: float = Field(default=36.0, ge=1, le=1000)
    clip_start: float = Field(default=0.01, ge=1e-4)
    clip_end: float = Field(default=100.0, le=1e6)

    @model_validator(mode="after")
    def _clip_range_is_not_empty(self) -> Self:
        if self.clip_end <= self.clip_start:
            raise ValueError(f"clip_end {self.clip_end} must be greater than clip_start {self.clip_start}")
        return self


class Keyframe(_Spec):
    """Where the camera is at ``time``, 0 the first frame and 1 the last, and where it looks.

    Exactly one of ``look_at`` (a point that appears in the image's centre, world z upwards) and ``quat_wxyz`` (the
    rotation world_from_camera, OpenCV axes: x right, y down, z forward) is given. ``interpolation`` leads to the next
    key.
    """

    time: Fraction
    position: Vector
    look_at: Vector | None = None
    quat_wxyz: tuple[float, float, float, float] | None = None
    interpolation: Literal["linear", "smooth"] = "smooth"

    @model_validator(mode="after")
    def _is_oriented_in_one_way(self) -> Self:
        if (self.look_at is None) == (self.quat_wxyz is None):
            raise ValueError("give exactly one of look_at and quat_wxyz")
        if self.quat_wxyz is not None and abs(sum(q * q for q in self.quat_wxyz) - 1) > 1e-3:
            raise ValueError(f"quat_wxyz {list(self.quat_wxyz)} must have length 1")
        if self.look_at is not None:
            dx, dy, dz = (a - b for a, b in zip(self.look_at, self.position, strict=True))
            if dx * dx + dy * dy <= 1e-12 * (dx * dx + dy * dy + dz * dz):
                raise ValueError("look_at must not lie at, straight above or below position; use quat_wxyz there")
        return self


class ObjectSettings(_Spec):
    """A shape in Blender's own size: round ones of radius 1, cube and plane of side 2, Suzanne 2.7 wide.

    It is scaled (by one number or by one an axis), turned about x, then y, then z, and moved. ``subdivision`` rounds
    it by that many Catmull-Clark levels; ``smooth`` shades across faces and leaves the geometry as it is.
    """

    name: Name
    shape: Literal["suzanne", "sphere", "cube", "plane", "cylinder", "cone", "torus"]
    material: Name
    location: Vector = (0.0, 0.0, 0.0)
    rotation_deg: Vector = (0.0, 0.0, 0.0)
    scale: Scale = (1.0, 1.0, 1.0)
    subdivision: int = Field(default=0, ge=0, le=6)
    smooth: bool = False


class MaterialSettings(_Spec):
    """A surface of one colour."""

    color: Color
    roughness: Fraction = 0.5
    metallic: Fraction = 0.0


class LightSettings(_Spec):
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


class WorldSettings(_Spec):
    """The background, which lights the scene from all sides."""

    color: Color = (0.8, 0.8, 0.8)
    strength: NotNegative = 1.0


class Scene(_Spec):
    """A whole scene file."""

    name: Name
    description: str = ""
    render: RenderSettings = RenderSettings()
    camera: CameraSettings = CameraSettings()
    world: WorldSettings = WorldSettings()
    materials: dict[str, MaterialSettings]
    objects: tuple[ObjectSettings, ...]
    lights: tuple[LightSettings, ...] = ()
    keyframes: tuple[Keyframe, ...]

    @field_validator("keyframes")
    @classmethod
    def _keys_follow_each_other(cls, keys: tuple[Keyframe, ...]) -> tuple[Keyframe, ...]:
        if not keys:
            raise ValueError("give at least one")
        for i, (key, following) in enumerate(pairwise(keys)):
            if following.time <= key.time:
                raise ValueError(
                    f"times must increase, but key [{i + 1}] has time {following.time} after {key.time} of key [{i}]"
                )
            if (following.look_at is None) != (key.look_at is None):
                raise ValueError(f"use look_at in all keys or quat_wxyz in all; keys [{i}] and [{i + 1}] differ")
        return keys

    @field_validator("objects")
    @classmethod
    def _names_are_unique(cls, objects: tuple[ObjectSettings, ...]) -> tuple[ObjectSettings, ...]:
        if not objects:
            raise ValueError("give at least one")
        seen: dict[str, int] = {}
        for i, settings in enumerate(objects):
            if settings.name in seen:
                raise ValueError(f"objects [{seen[settings.name]}] and [{i}] have the same name, {settings.name!r}")
            seen[settings.name] = i
        return objects

    @model_validator(mode="after")
    def _materials_exist(self) -> Self:
        for i, settings in enumerate(self.objects):
            if settings.material not in self.materials:
                known = ", ".join(sorted(self.materials)) or "none"
                raise ValueError(f"objects[{i}].material: no material {settings.material!r}; there are: {known}")
        return self
