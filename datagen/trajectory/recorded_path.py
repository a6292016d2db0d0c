"""A recorded path played in the scene."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from datagen.errors import InputError
from datagen.scene_spec.trajectory_settings import RecordedTrajectory
from datagen.trajectory.pose_files import Recording, read_recording
from datagen.trajectory.viewing import poses

Array = NDArray[np.float64]

AT_A_POSE = 1e-9
"""In parts of the time between two poses: nearer to one than this, the pose itself is taken."""


def recorded_path(settings: RecordedTrajectory, frames: int, frames_per_second: float) -> Array:
    """Return world_from_camera (N, 4, 4) of a recording, placed in the scene.

    Raises InputError where the file cannot be used or has too few poses for the frames asked for.
    """
    recording = read_recording(Path(settings.file))
    path = _in_time(recording, settings, frames, frames_per_second)
    turn = Rotation.from_euler("xyz", settings.rotation_deg, degrees=True)
    positions = settings.scale * turn.apply(path[:, :3, 3]) + np.asarray(settings.location)
    return poses(turn.as_matrix() @ path[:, :3, :3], positions)


def interpolate_poses(recording: Recording, times: ArrayLike) -> Array:
    """Return poses (N, 4, 4) at ``times`` (N,): position on a line, rotation on the shortest arc (Shoemake 1985).

    At a recorded time the result is the recorded pose, bit for bit; outside of them it is the first or the last.
    """
    known, at = recording.times, np.asarray(times, dtype=np.float64)
    if len(known) == 1:
        return np.repeat(recording.world_from_camera, len(at), axis=0)
    before = np.clip(np.searchsorted(known, at, side="right") - 1, 0, len(known) - 2)
    part = np.clip((at - known[before]) / (known[before + 1] - known[before]), 0, 1)
    start, end = recording.world_from_camera[before], recording.world_from_camera[before + 1]
    turn = (Rotation.from_matrix(start[:, :3, :3]).inv() * Rotation.from_matrix(end[:, :3, :3])).as_rotvec()
    turned = start[:, :3, :3] @ Rotation.from_rotvec(part[:, None] * turn).as_matrix()
    result = poses(turned, (1 - part[:, None]) * start[:, :3, 3] + part[:, None] * end[:, :3, 3])
    for chosen, pose in ((part < AT_A_POSE, start), (part > 1 - AT_A_POSE, end)):
        result[chosen] = pose[chosen]
    return result


def _in_time(recording: Recording, settings: RecordedTrajectory, frames: int, frames_per_second: float) -> Array:
    count = len(recording.times)
    if settings.timing == "as-is":
        if frames > count:
            raise InputError(
                f"{settings.file}: has {count} poses, but {frames} frames are asked for; render at most {count}, or "
                'set trajectory.timing to "fit" to interpolate between them'
            )
        return recording.world_from_camera[:frames]
    first, last = recording.times[0], recording.times[-1]
    if settings.timing == "fit":
        return interpolate_poses(recording, first + (last - first) * (np.arange(frames) / max(frames - 1, 1)))
    if not recording.is_timed:
        raise InputError(f'{settings.file}: has no times; set trajectory.timing to "fit" or "as-is"')
    most = int((last - first) * frames_per_second * (1 + 1e-9)) + 1
    if frames > most:
        raise InputError(
            f"{settings.file}: lasts {last - first:g} s, at {frames_per_second:g} frames a second {most} frames, but "
            f'{frames} are asked for; render fewer, or set trajectory.timing to "fit"'
        )
    return interpolate_poses(recording, first + np.arange(frames) / frames_per_second)
