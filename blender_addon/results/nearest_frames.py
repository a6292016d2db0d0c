"""Which fused frames see a point best, nearest first."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..files.reconstruction_files import FusedFrame, Intrinsics

Sees = Callable[[NDArray[np.float64]], bool]
"""Tells whether nothing hides the point from a position in the world."""


def frames_seeing(
    point_world: NDArray[np.float64],
    trajectory: Sequence[FusedFrame],
    intrinsics: Intrinsics,
    *,
    is_visible: Sees = lambda position: True,  # noqa: ARG005
) -> list[int]:
    """Return the numbers of all frames: those that show the point first, and among them the nearest first.

    A frame shows it where it lies before the camera, within the image, and nothing hides it.
    """
    poses = np.array([frame.world_from_camera for frame in trajectory])
    offsets = point_world - poses[:, :3, 3]
    x, y, z = np.einsum("nij,ni->nj", poses[:, :3, :3], offsets).T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = intrinsics.fx * x / z + intrinsics.cx, intrinsics.fy * y / z + intrinsics.cy
    shown = (z > 0) & (np.abs(u - (intrinsics.width - 1) / 2) <= intrinsics.width / 2)
    shown &= np.abs(v - (intrinsics.height - 1) / 2) <= intrinsics.height / 2
    for i in np.flatnonzero(shown):
        shown[i] = is_visible(poses[i, :3, 3])
    order = np.lexsort((np.linalg.norm(offsets, axis=1), ~shown))
    return [trajectory[i].frame for i in order]
