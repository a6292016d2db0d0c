"""Where the camera is in each frame, whatever the kind of trajectory: the one place that knows."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.errors import InputError
from datagen.scene_spec.scene import Scene
from datagen.scene_spec.trajectory_settings import (
    BlendCameraTrajectory,
    HemisphereTrajectory,
    KeyframeTrajectory,
    OrbitTrajectory,
    RecordedTrajectory,
    ShellTrajectory,
    Trajectory,
)
from datagen.trajectory.generated_paths import hemisphere, orbit, shell, turns_of
from datagen.trajectory.keyframe_path import keyframe_path
from datagen.trajectory.recorded_path import recorded_path
from datagen.trajectory.shake import shaken

SMALL_STEPS = 500
"""Into so many at least the way between frames is cut, on which it is not to pass through things."""


def camera_path(settings: Trajectory, frames: int, frames_per_second: float, seed: int) -> NDArray[np.float64]:
    """Return world_from_camera (N, 4, 4), metres, OpenCV axes, of each of ``frames`` frames.

    A frame's pose depends on the arguments alone, not on which frames are rendered. Raises InputError where the
    settings do not fit so many frames, where a recording cannot be used, and for the camera of a .blend, which only
    Blender can move.
    """
    path = _steady_path(settings, frames, frames_per_second, seed)
    if settings.shake is None:
        return path
    return shaken(path, settings.shake, frames_per_second=frames_per_second, seed=seed)


def scene_camera_path(scene: Scene) -> NDArray[np.float64]:
    """Return the camera's path (N, 4, 4) in ``scene`` as it will be rendered. Raises as ``camera_path`` does."""
    render = scene.render
    return camera_path(scene.camera_motion, render.frames, render.frames_per_second, render.seed)


@dataclass(frozen=True, kw_only=True)
class Way:
    """The camera's way from frame to frame: ``positions_world`` (M, 3) and the ``frames`` (M,), with fractions."""

    positions_world: NDArray[np.float64]
    frames: NDArray[np.float64]


def way_between_frames(settings: Trajectory, frames: int, frames_per_second: float, seed: int) -> Way | None:
    """Return the way that the camera takes between frames, in steps that are small also where frames are few.

    None where there is no such way: random views do not follow each other, and of the camera of a .blend and of a
    recording taken as it is only the frames are known.
    """
    if isinstance(settings, ShellTrajectory | BlendCameraTrajectory):
        return None
    if isinstance(settings, RecordedTrajectory) and settings.timing == "as-is":
        path = camera_path(settings, frames, frames_per_second, seed)
        return Way(positions_world=path[:, :3, 3], frames=np.arange(frames, dtype=np.float64))
    parts = max(1, math.ceil(SMALL_STEPS / frames))
    if isinstance(settings, HemisphereTrajectory):
        settings = settings.model_copy(update={"turns": turns_of(settings, frames)})
        at = (np.arange(frames * parts) + 0.5) / parts - 0.5
    else:
        at = np.arange((frames - 1) * parts + 1) / parts
    path = camera_path(settings, len(at), frames_per_second * parts, seed)
    return Way(positions_world=path[:, :3, 3], frames=at)


def _steady_path(settings: Trajectory, frames: int, frames_per_second: float, seed: int) -> NDArray[np.float64]:
    if isinstance(settings, KeyframeTrajectory):
        return keyframe_path(settings.keyframes, frames)
    if isinstance(settings, OrbitTrajectory):
        return orbit(settings, frames)
    if isinstance(settings, HemisphereTrajectory):
        return hemisphere(settings, frames)
    if isinstance(settings, ShellTrajectory):
        return shell(settings, frames, seed)
    if isinstance(settings, RecordedTrajectory):
        return recorded_path(settings, frames, frames_per_second)
    assert isinstance(settings, BlendCameraTrajectory)
    raise InputError(
        "trajectory: the camera of a .blend moves in Blender alone; its path is known once frames are rendered"
    )
