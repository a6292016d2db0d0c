"""Where the camera is and where it looks."""

from typing import Literal, Self

from pydantic import model_validator

from datagen.scene_spec.base import Fraction, Spec, Vector


class Keyframe(Spec):
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
