"""Where the camera is and where it looks."""

from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from datagen.scene_spec.base import Fraction, Spec, Vector

Interpolation = Literal[
    "linear", "smooth", "constant", "sine", "quad", "cubic", "quart", "quint", "expo", "circ", "back", "bounce",
    "elastic",
]  # fmt: skip
Easing = Literal["auto", "in", "out", "in-out"]
Offset = tuple[float, float]
Offsets = Annotated[tuple[Offset, ...], Field(min_length=3, max_length=4)]


class Handles(Spec):
    """Bézier handles of a key's F-curves, which take the place of the automatic ones.

    ``left`` and ``right`` have one [time, value] for each component (x, y, z), as offsets from the key: time as in
    ``Keyframe.time``, so that it is at most 0 on the left and at least 0 on the right. A side that is not given
    mirrors the other.
    """

    left: Offsets | None = None
    right: Offsets | None = None

    @property
    def both(self) -> tuple[tuple[Offset, ...], tuple[Offset, ...]]:
        """The offsets of the left and of the right handle."""
        left, right = self.left, self.right
        if left is None:
            assert right is not None
            left = tuple((-time, -value) for time, value in right)
        return left, right if right is not None else tuple((-time, -value) for time, value in left)

    @model_validator(mode="after")
    def _lie_on_their_sides(self) -> Self:
        if self.left is None and self.right is None:
            raise ValueError("give left, right or both")
        left, right = self.both
        if len(left) != len(right):
            raise ValueError(f"left has {len(left)} components, right {len(right)}")
        if any(time > 0 for time, _ in left) or any(time < 0 for time, _ in right):
            raise ValueError("a left handle's time must be at most 0, a right handle's at least 0")
        return self


class Keyframe(Spec):
    """Where the camera is at ``time``, 0 the first frame and 1 the last, and where it looks.

    Exactly one of ``look_at`` (a point that appears in the image's centre, world z upwards) and ``quat_wxyz`` (the
    rotation world_from_camera, OpenCV axes: x right, y down, z forward) is given. ``interpolation`` leads to the next
    key: "smooth" is a Bézier curve with automatic handles or with those given here, "constant" holds the key, and the
    others are Blender's easing equations, whose ``easing`` is "auto" (as Blender chooses), "in", "out" or "in-out".
    """

    time: Fraction
    position: Vector
    look_at: Vector | None = None
    quat_wxyz: tuple[float, float, float, float] | None = None
    interpolation: Interpolation = "smooth"
    easing: Easing = "auto"
    position_handles: Handles | None = None
    look_at_handles: Handles | None = None
    quat_wxyz_handles: Handles | None = None

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

    @model_validator(mode="after")
    def _handles_belong_to_what_is_given(self) -> Self:
        for name in ("position", "look_at", "quat_wxyz"):
            handles, value = getattr(self, f"{name}_handles"), getattr(self, name)
            if handles is None:
                continue
            if value is None:
                raise ValueError(f"{name}_handles need {name}")
            if len(handles.both[0]) != len(value):
                raise ValueError(f"{name}_handles need {len(value)} components, found {len(handles.both[0])}")
        return self


def _follow_each_other(keys: tuple[Keyframe, ...]) -> tuple[Keyframe, ...]:
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


Keyframes = Annotated[tuple[Keyframe, ...], AfterValidator(_follow_each_other)]
