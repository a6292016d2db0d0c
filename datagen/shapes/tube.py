"""Round rods along a curve: handles, stems, bananas."""

from collections.abc import Sequence

import numpy as np

from datagen.shapes.curves import lengths_along, through_points
from datagen.shapes.rings import skin
from datagen.shapes.solid import Array, Solid

SEGMENTS = 32
CAP_RINGS = 6


def tube(path: Sequence[tuple[float, float, float]], radius: float | Sequence[float]) -> Solid:
    """Return a rod along a curve through ``path`` (metres), with half balls as its ends.

    ``radius`` is one number, or one for each point of the path.
    """
    radii = np.broadcast_to(np.asarray(radius, np.float64), len(path))
    points = np.concatenate([np.array(path, np.float64), radii[:, None]], axis=1)
    curve = through_points(points, before=2 * points[0] - points[1], after=2 * points[-1] - points[-2])
    centres, radii = curve[:, :3], curve[:, 3]
    tangents = np.gradient(centres, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    centres, radii, tangents, tilt = _with_caps(centres, radii, tangents)
    side, other = _frames(tangents)
    angles = np.arange(SEGMENTS) * 2 * np.pi / SEGMENTS
    around = np.cos(angles)[:, None] * side[:, None] + np.sin(angles)[:, None] * other[:, None]
    normals = np.cos(tilt)[:, None, None] * around + np.sin(tilt)[:, None, None] * tangents[:, None]
    # Lengths over the caps too, where the centres stand closer than the skin is long.
    along = lengths_along(centres[:, :] + radii[:, None] * side)
    u = np.linspace(0, 2 * np.pi * radii.max(), SEGMENTS + 1)
    uv = np.stack(np.meshgrid(u, along), axis=-1)[..., ::-1]
    return skin(centres[:, None] + radii[:, None, None] * around, normals, uv, closed=False)


def _with_caps(centres: Array, radii: Array, tangents: Array) -> tuple[Array, Array, Array, Array]:
    """Return the rings with those of the half balls at both ends, and by what angle their normals lean forward."""
    angle = np.linspace(np.pi / 2, 0, CAP_RINGS, endpoint=False)
    backward, forward = -np.sin(angle) * radii[0], np.sin(angle[::-1]) * radii[-1]
    return (
        np.concatenate(
            [
                centres[0] + backward[:, None] * tangents[0],
                centres,
                centres[-1] + forward[:, None] * tangents[-1],
            ]
        ),
        np.concatenate([_ending(np.cos(angle)) * radii[0], radii, _ending(np.cos(angle))[::-1] * radii[-1]]),
        np.concatenate([np.repeat(tangents[:1], CAP_RINGS, 0), tangents, np.repeat(tangents[-1:], CAP_RINGS, 0)]),
        np.concatenate([-angle, np.zeros(len(centres)), angle[::-1]]),
    )


def _ending(cosines: Array) -> Array:
    return np.concatenate([[0.0], cosines[1:]])


def _frames(tangents: Array) -> tuple[Array, Array]:
    """Return two unit vectors across each tangent, carried along without twist."""
    start = np.eye(3)[np.argmin(np.abs(tangents[0]))]
    sides = []
    for tangent in tangents:
        start = start - (start @ tangent) * tangent
        start = start / np.linalg.norm(start)
        sides.append(start)
    side = np.array(sides)
    return side, np.cross(tangents, side)
