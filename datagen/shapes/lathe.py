"""Shapes turned on a lathe: mugs, bowls, bottles, plates, lamp shades, apples."""

from collections.abc import Sequence

import numpy as np

from datagen.shapes.curves import lengths_along, right_of, rounded, through_points
from datagen.shapes.rings import skin
from datagen.shapes.solid import Solid

SEGMENTS = 96
DEFAULT_BEVEL = 0.001


def lathe(profile: Sequence[tuple[float, float]], *, bevel: float | None = None, spline: bool = False) -> Solid:
    """Revolve ``profile``, [radius, z] points in metres, about z.

    It begins and ends on the axis, or ends at its first point, which makes a ring. Corners are rounded with the radius
    ``bevel``; with ``spline`` a curve goes through the points instead, across the axis without a tip.
    """
    points = np.array(profile, np.float64)
    closed = profile[0] == profile[-1]
    if spline:
        mirror = np.array([-1.0, 1.0])
        before, after = (points[-2], points[1]) if closed else (points[1] * mirror, points[-2] * mirror)
        points = through_points(points, before=before, after=after)
        slopes = np.gradient(points, axis=0)
        if closed:
            slopes[0] = points[1] - points[-2]
            points, slopes = points[:-1], slopes[:-1]
        normals = right_of(slopes / np.linalg.norm(slopes, axis=1, keepdims=True))
    else:
        points = points[:-1] if closed else points
        points, normals = rounded(points, DEFAULT_BEVEL if bevel is None else bevel, closed=closed)
    if not closed:
        points[[0, -1], 0] = 0
        normals[[0, -1]] = [[0, np.sign(normals[0, 1]) or -1], [0, np.sign(normals[-1, 1]) or 1]]
    return _revolved(points, normals, closed=closed)


def _revolved(points: np.ndarray, normals: np.ndarray, *, closed: bool) -> Solid:
    angles = np.arange(SEGMENTS) * 2 * np.pi / SEGMENTS
    around = np.stack([np.cos(angles), np.sin(angles), np.zeros(SEGMENTS)], axis=-1)
    up = np.array([0.0, 0.0, 1.0])
    along = lengths_along(np.concatenate([points, points[:1]]) if closed else points)
    u = np.linspace(0, 2 * np.pi * points[:, 0].max(), SEGMENTS + 1)
    return skin(
        points[:, None, :1] * around + points[:, None, 1:] * up,
        normals[:, None, :1] * around + normals[:, None, 1:] * up,
        np.stack(np.meshgrid(u, along), axis=-1),
        closed=closed,
    )
