"""A view of the whole: where to stand, with what is up in the scan up in the picture."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from datagen.rigid import Matrix, look_at

Z_UP_WITHIN_DEG = 35.0
"""Cameras held upright on average as far from Z as this mean a scan with Z up; others say themselves what is up."""
STEADY_LOOK = 0.35
"""Length of the mean horizontal viewing direction above which a scan looks one way, as in a corner of a room."""
FRONT = (-0.55, 1.0, 0.0)
"""Direction to look along where a scan has none, as around an object: its front, which is −Y, from the right."""
DESCENT = 0.5
"""How steeply the view goes down: the tangent of the angle."""
MARGIN = 0.92
"""Part of the picture that may be filled."""
STRAY_PERCENT = 1.0
"""Of a mesh's vertices, that may lie out of view on each side: depth errors leave specks far from all else."""


class FieldOfView(NamedTuple):
    """Tangents of half the angles of view."""

    tan_half_x: float
    tan_half_y: float


def overview_pose(
    points_world: NDArray[np.floating], cameras: Sequence[Matrix], *, field_of_view: FieldOfView
) -> Matrix:
    """Return world_from_camera, OpenCV axes, of a camera that sees all of ``points_world`` (N, 3).

    ``cameras`` are the world_from_camera of the scan: from behind them where they look one way, else from the front.
    """
    pose = look_at((0, 0, 0), overview_direction(cameras), up=_up(cameras))
    pose[:3, 3] = _position(points_world, pose[:3, :3], field_of_view)
    return pose


def overview_direction(cameras: Sequence[Matrix]) -> NDArray[np.float64]:
    """Return the unit direction, world frame, in which the overview of a scan by ``cameras`` looks."""
    up = _up(cameras)
    look = np.mean([pose[:3, 2] for pose in cameras], axis=0) if cameras else np.zeros(3)
    look -= up * (look @ up)
    if np.linalg.norm(look) < STEADY_LOOK:
        look = np.asarray(FRONT) - up * (np.asarray(FRONT) @ up)
    direction = look / np.linalg.norm(look) - DESCENT * up
    return direction / np.linalg.norm(direction)


def without_strays(points_world: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return ``points_world`` (N, 3) without the outermost ``STRAY_PERCENT`` on each side of each axis."""
    low, high = np.percentile(points_world, [STRAY_PERCENT, 100 - STRAY_PERCENT], axis=0)
    return points_world[((points_world >= low) & (points_world <= high)).all(axis=1)]


def _up(cameras: Sequence[Matrix]) -> NDArray[np.float64]:
    z_up = np.array([0.0, 0.0, 1.0])
    mean = -np.mean([pose[:3, 1] for pose in cameras], axis=0) if cameras else z_up
    length = np.linalg.norm(mean)
    if length < 1e-3 or mean[2] / length > np.cos(np.radians(Z_UP_WITHIN_DEG)):
        return z_up
    return mean / length


def _position(
    points_world: NDArray[np.floating], world_from_camera_rotation: NDArray[np.float64], field_of_view: FieldOfView
) -> NDArray[np.float64]:
    """Return the nearest position from which all points are in view.

    A point is right of the left edge where x − x₀ ≥ −t (z − z₀), and so on: along each image axis the tightest edges
    meet at one place, the farther back of the two counts.
    """
    x, y, z = (points_world @ world_from_camera_rotation).T
    centre, back = [], []
    for along, tan_half in ((x, field_of_view.tan_half_x), (y, field_of_view.tan_half_y)):
        tangent = MARGIN * tan_half
        high, low = np.max(along - tangent * z), np.max(-along - tangent * z)
        centre.append((high - low) / 2)
        back.append((high + low) / 2 / tangent)
    return world_from_camera_rotation @ np.array([*centre, -max(back)])
