"""How far camera poses are from each other."""

import numpy as np
from numpy.typing import NDArray

from datagen.rigid import Matrix


def pose_distances(world_from_camera: NDArray[np.float64], pose: Matrix, *, depth: float) -> NDArray[np.float64]:
    """Return how far poses (n, 4, 4) are from another, in radians (n,).

    A rotation's angle and the camera's shift as seen at ``depth`` metres count alike: √(θ² + (‖t‖/depth)²), a geodesic
    distance of SO(3) × R³.
    """
    relative = np.swapaxes(world_from_camera[:, :3, :3], 1, 2) @ pose[:3, :3]
    sines = np.stack([relative[:, i, j] - relative[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1)
    angles = np.arctan2(np.linalg.norm(sines, axis=1), np.trace(relative, axis1=1, axis2=2) - 1)
    shifts = np.linalg.norm(world_from_camera[:, :3, 3] - pose[:3, 3], axis=1)
    return np.hypot(angles, shifts / depth)


def first_apart(
    poses: NDArray[np.float64], *, apart: float, depth: float, most: int | None = None
) -> NDArray[np.int64]:
    """Return the indices of the first of ``poses`` (n, 4, 4) that are ``apart`` radians, or more, from those before.

    Distances are those of ``pose_distances``; at most ``most`` are returned.
    """
    chosen: list[int] = []
    left = np.ones(len(poses), bool)
    while left.any() and (most is None or len(chosen) < most):
        chosen.append(int(left.argmax()))
        left[chosen[-1]] = False
        left &= pose_distances(poses, poses[chosen[-1]], depth=depth) >= apart
    return np.array(chosen, np.int64)
