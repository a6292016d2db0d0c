"""Where the camera is in each frame, whatever the kind of trajectory: the one place that knows."""

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
from datagen.trajectory.generated_paths import hemisphere, orbit, shell
from datagen.trajectory.keyframe_path import keyframe_path
from datagen.trajectory.recorded_path import recorded_path
from datagen.trajectory.shake import shaken


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
