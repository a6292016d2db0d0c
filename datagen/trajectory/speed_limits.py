"""How fast the camera moves and turns, and whether that is too fast."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.errors import InputError
from datagen.scene_spec.trajectory_settings import BlendCameraTrajectory, SpeedLimits, Trajectory
from datagen.trajectory.camera_path import camera_path
from datagen.trajectory.frame_ranges import frame_ranges

Array = NDArray[np.float64]

TRIES = 12
MOST_FRAMES = 1_000_000
ROUNDING = 1e-9
"""A speed that is above its limit by less than this part is at it."""


@dataclass(frozen=True, kw_only=True)
class Excess:
    """Frames that are reached too fast: which, how fast the fastest is, and what ``key`` allows."""

    key: str
    unit: str
    frames: tuple[int, ...]
    fastest: float
    limit: float


def speeds(path: Array, frames_per_second: float) -> tuple[Array, Array]:
    """Return metres and degrees a second (N,) at which a path (N, 4, 4) comes to each frame; 0 for the first one."""
    moved = np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1)
    rotations = Rotation.from_matrix(path[:, :3, :3])
    turned = np.degrees((rotations[:-1].inv() * rotations[1:]).magnitude()) if len(path) > 1 else np.zeros(0)
    return np.append(0.0, moved) * frames_per_second, np.append(0.0, turned) * frames_per_second


def exceeded(path: Array, limits: SpeedLimits, frames_per_second: float) -> list[Excess]:
    """Return which limits a path (N, 4, 4) exceeds, and in which frames."""
    found = []
    rows = zip(
        ("max_speed", "max_turn_deg"), ("m/s", "°/s"), speeds(path, frames_per_second), strict=True
    )  # fmt: skip
    for key, unit, speed in rows:
        limit = getattr(limits, key)
        if limit is None:
            continue
        frames = np.flatnonzero(speed > limit * (1 + ROUNDING))
        if len(frames):
            found.append(
                Excess(key=key, unit=unit, frames=tuple(frames.tolist()), fastest=float(speed.max()), limit=limit)
            )
    return found


def frames_needed(
    settings: Trajectory, path: Array, limits: SpeedLimits, *, frames_per_second: float, seed: int
) -> int | None:
    """Return with how many frames a trajectory keeps its limits, or None where more frames do not slow it down.

    ``path`` (N, 4, 4) is what it is with its present number of frames.
    """
    for _ in range(TRIES):
        found = exceeded(path, limits, frames_per_second)
        if not found:
            return len(path)
        too_fast_by = max(excess.fastest / excess.limit for excess in found)
        frames = max(math.ceil((len(path) - 1) * too_fast_by * (1 - ROUNDING)), len(path)) + 1
        if frames > MOST_FRAMES:
            return None
        if isinstance(settings, BlendCameraTrajectory):
            return None if settings.shake is not None else frames
        try:
            path = camera_path(settings, frames, frames_per_second, seed)
        except InputError:
            return None  # so long is no recording
    return None


def require_within_limits(settings: Trajectory, path: Array, *, frames_per_second: float, seed: int) -> None:
    """Raise InputError naming the frames of ``path`` that exceed the trajectory's limits, and what would mend it."""
    if settings.limits is None:
        return
    found = exceeded(path, settings.limits, frames_per_second)
    if not found:
        return
    faults = [
        f"{frame_ranges(excess.frames)}: the camera {'moves' if excess.key == 'max_speed' else 'turns'} at up to "
        f"{excess.fastest:.3g} {excess.unit}, {excess.fastest / excess.limit:.3g} times trajectory.limits.{excess.key} "
        f"({excess.limit:g} {excess.unit})"
        for excess in found
    ]
    needed = frames_needed(settings, path, settings.limits, frames_per_second=frames_per_second, seed=seed)
    remedy = "calm the path or raise the limits" if needed is None else f"render {needed} frames, or raise the limits"
    raise InputError(f"the camera's path: {'; '.join(faults)}; {remedy}")
