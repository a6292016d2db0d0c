"""How the camera moves, where it is not by the keyframes of the scene file alone."""

from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from datagen.scene_spec.base import Fraction, Name, NotNegative, Positive, Spec, Vector
from datagen.scene_spec.keyframes import Keyframes

Direction = Literal["counter-clockwise", "clockwise"]
Elevation = Annotated[float, Field(ge=-90, le=90)]


def _one_or_many(value: Any) -> Any:
    return (value,) if isinstance(value, str) else tuple(value) if isinstance(value, list) else value


class ShakeSettings(Spec):
    """Hand-held shake on top of a trajectory: smooth seeded noise of the camera's position and rotation.

    ``position`` (metres) and ``rotation_deg`` are root mean squares along and about each of the camera's axes;
    ``frequency_hz`` is the band of frequencies that the noise has.
    """

    position: NotNegative = 0.004
    rotation_deg: Annotated[float, Field(ge=0, le=45)] = 0.4
    frequency_hz: tuple[NotNegative, Positive] = (0.5, 4.0)

    @model_validator(mode="after")
    def _band_is_not_empty(self) -> Self:
        low, high = self.frequency_hz
        if low >= high:
            raise ValueError(f"frequency_hz {[low, high]} must be [lowest, highest]")
        return self


class SpeedLimits(Spec):
    """How fast the camera may move, metres a second, and turn, degrees a second."""

    max_speed: Positive | None = None
    max_turn_deg: Positive | None = None

    @model_validator(mode="after")
    def _limit_something(self) -> Self:
        if self.max_speed is None and self.max_turn_deg is None:
            raise ValueError("give max_speed, max_turn_deg or both")
        return self


class TrajectoryBase(Spec):
    """What every trajectory may have.

    Before the first frame is rendered, the path is checked unless ``check`` is false: the camera keeps ``clearance``
    (metres; where not given, the distance of the near plane's corners) from every surface, passes through none, and
    at least the fraction ``min_in_view`` of the ``subject``'s bounding boxes is in the image. The subject is one
    object's name or several; where not given, it is all objects but those that the camera moves above, below or
    inside, as floors and rooms.
    """

    shake: ShakeSettings | None = None
    limits: SpeedLimits | None = None
    check: bool = True
    subject: Annotated[tuple[Name, ...], BeforeValidator(_one_or_many)] = ()
    min_in_view: Fraction = 0.1
    clearance: NotNegative | None = None


class KeyframeTrajectory(TrajectoryBase):
    """Keys as Blender's F-curves, with what the scene file's own list of keyframes has no place for."""

    type: Literal["keyframes"] = "keyframes"
    keyframes: Keyframes


class OrbitTrajectory(TrajectoryBase):
    """A circle about the vertical through ``center``, ``radius`` metres from it and seen from ``elevation_deg``.

    ``start_angle_deg`` counts from the world's x axis towards y, ``direction`` is as seen from above. The camera looks
    at ``look_at``, where not given at the centre. After whole ``turns`` the last frame is where the first was.
    """

    type: Literal["orbit"]
    center: Vector = (0.0, 0.0, 0.0)
    radius: Positive
    elevation_deg: Annotated[float, Field(gt=-90, lt=90)] = 30.0
    turns: Positive = 1.0
    start_angle_deg: float = -90.0
    direction: Direction = "counter-clockwise"
    look_at: Vector | None = None


class HemisphereTrajectory(TrajectoryBase):
    """A spiral that covers a hemisphere, or the belt between two elevations, evenly and in one continuous motion.

    Each frame stands for the same area. Where ``turns`` is not given, they lie as far apart as frames that follow each
    other, which covers best, and their number grows with the frames'. Near the zenith the camera, which keeps upright,
    spins; for a calm video end at an elevation of some 70 degrees and set the turns.
    """

    type: Literal["hemisphere"]
    center: Vector = (0.0, 0.0, 0.0)
    radius: Positive
    elevation_deg: tuple[Elevation, Elevation] = (0.0, 90.0)
    turns: Positive | None = None
    start_angle_deg: float = -90.0
    direction: Direction = "counter-clockwise"
    look_at: Vector | None = None

    @model_validator(mode="after")
    def _has_room(self) -> Self:
        low, high = self.elevation_deg
        if low == high:
            raise ValueError(f"elevation_deg {[low, high]} must be two elevations, the first and the last")
        return self


class ShellTrajectory(TrajectoryBase):
    """Random views, uniform over the directions between two elevations, seeded; not a motion.

    ``radius`` is the range of distances from ``center``. The camera looks at a random point within ``look_at_jitter``
    metres of ``look_at`` (where not given, of the centre), and rolls by at most ``roll_deg`` either way.
    """

    type: Literal["shell"]
    center: Vector = (0.0, 0.0, 0.0)
    radius: tuple[Positive, Positive]
    elevation_deg: tuple[Elevation, Elevation] = (-90.0, 90.0)
    look_at: Vector | None = None
    look_at_jitter: NotNegative = 0.0
    roll_deg: Annotated[float, Field(ge=0, le=180)] = 0.0

    @model_validator(mode="after")
    def _ranges_increase(self) -> Self:
        for name in ("radius", "elevation_deg"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name} {[low, high]} must be [smallest, largest]")
        if self.limits is not None:
            raise ValueError("limits have no meaning for random views, which do not follow each other")
        return self


class RecordedTrajectory(TrajectoryBase):
    """A path from a ``file``: TUM (``t tx ty tz qx qy qz qw``), Open3D's ``.log``, or a folder of 4×4 pose files.

    Its path is relative to the scene file; ``sha256`` identifies its content, reading the scene fills it in.
    ``timing`` "fit" stretches the recording over the frames, "real-time" plays it at the frame rate, both interpolating
    position and rotation between its poses, and "as-is" takes a pose a frame. The recording's world is scaled, turned
    about x, then y, then z, and moved into the scene's.
    """

    type: Literal["recorded"]
    file: Annotated[str, Field(min_length=1)]
    sha256: str | None = None
    timing: Literal["fit", "real-time", "as-is"] = "fit"
    location: Vector = (0.0, 0.0, 0.0)
    rotation_deg: Vector = (0.0, 0.0, 0.0)
    scale: Positive = 1.0


class BlendCameraTrajectory(TrajectoryBase):
    """The animation of a .blend's own camera from ``first_frame`` to ``last_frame``, stretched over the frames.

    Where they are not given, they are the .blend's.
    """

    type: Literal["blend-camera"]
    first_frame: int | None = None
    last_frame: int | None = None


Trajectory = Annotated[
    KeyframeTrajectory
    | OrbitTrajectory
    | HemisphereTrajectory
    | ShellTrajectory
    | RecordedTrajectory
    | BlendCameraTrajectory,
    Field(discriminator="type"),
]
