"""Camera poses from where cameras are and what they look at."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from datagen.errors import InputError

Array = NDArray[np.float64]
"""Of one path: (N, 4, 4) world_from_camera, (N, 3) positions in the world."""


def look_at_each(positions_world: Array, targets_world: ArrayLike) -> Array:
    """Return world_from_camera (N, 4, 4), OpenCV axes, of cameras that each see a target in the centre, z upwards.

    ``targets_world`` is (N, 3) or one point (3,). Raises InputError, naming the frame, where a camera is at its target
    or looks straight up or down, so that no side of the image is up.
    """
    forward = np.asarray(targets_world, dtype=np.float64) - positions_world
    distance = np.linalg.norm(forward, axis=1)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    undecided = np.flatnonzero(np.linalg.norm(right, axis=1) <= 1e-9 * distance)
    if len(undecided):
        i = undecided[0]
        raise InputError(
            f"trajectory: in frame {i} the camera, at {np.round(positions_world[i], 6).tolist()}, is at, straight "
            "above or below what it looks at: no side of the image is up; move the path or look_at a little aside"
        )
    forward /= distance[:, None]
    right /= np.linalg.norm(right, axis=1)[:, None]
    return poses(np.stack([right, np.cross(forward, right), forward], axis=-1), positions_world)


def poses(rotations: ArrayLike, positions_world: ArrayLike) -> Array:
    """Return 4×4 transforms (N, 4, 4) from rotation matrices (N, 3, 3) and positions (N, 3)."""
    result = np.tile(np.eye(4), (len(np.asarray(positions_world)), 1, 1))
    result[:, :3, :3] = rotations
    result[:, :3, 3] = positions_world
    return result


def rotation_of(quats_wxyz: ArrayLike) -> Rotation:
    """Return the rotations of quaternions (N, 4), which are scaled to length 1."""
    return Rotation.from_quat(np.roll(np.asarray(quats_wxyz, dtype=np.float64), -1, axis=-1))


def on_a_sphere(center: ArrayLike, radius: ArrayLike, azimuth: ArrayLike, sine_of_elevation: ArrayLike) -> Array:
    """Return points (N, 3) at ``radius`` from ``center``; azimuth in radians counts from x towards y."""
    height = np.asarray(sine_of_elevation, dtype=np.float64)
    across = np.sqrt(np.maximum(1 - height**2, 0))
    directions = np.stack(np.broadcast_arrays(across * np.cos(azimuth), across * np.sin(azimuth), height), axis=-1)
    return np.asarray(center) + np.asarray(radius, dtype=np.float64)[..., None] * directions
