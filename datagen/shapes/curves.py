"""Curves through points, and corners rounded off."""

from itertools import pairwise

import numpy as np

from datagen.shapes.solid import Array

ARC_STEP = np.radians(15)
STRAIGHT = np.radians(6)
"""Corners that turn by less are left as they are."""


def through_points(points: Array, *, before: Array, after: Array, steps: int = 8) -> Array:
    """Return a centripetal Catmull-Rom curve (N, D) through ``points`` (K, D), ``steps`` pieces between two of them.

    ``before`` and ``after`` are where the curve would come from and go on to. Barry and Goldman's algorithm.
    """
    control = np.concatenate([[before], points, [after]])
    pieces = []
    for i in range(len(points) - 1):
        p = control[i : i + 4]
        knots = np.concatenate(
            [[0], np.cumsum([max(float(np.linalg.norm(b - a)), 1e-9) ** 0.5 for a, b in pairwise(p)])]
        )
        t = np.linspace(knots[1], knots[2], steps, endpoint=False)[:, None]

        def blend(a: Array, b: Array, low: float, high: float, t: Array = t) -> Array:
            return (high - t) / (high - low) * a + (t - low) / (high - low) * b

        first = [blend(p[k], p[k + 1], knots[k], knots[k + 1]) for k in range(3)]
        second = [blend(first[k], first[k + 1], knots[k], knots[k + 2]) for k in range(2)]
        pieces.append(blend(second[0], second[1], knots[1], knots[2]))
    return np.concatenate([*pieces, points[-1:]])


def right_of(directions: Array) -> Array:
    """Return the directions (…, 2) turned by a quarter to the right."""
    return np.stack([directions[..., 1], -directions[..., 0]], axis=-1)


def rounded(points: Array, radius: float, *, closed: bool) -> tuple[Array, Array]:
    """Return a polyline (K, 2) with its corners rounded by arcs, and at each point the normal to the right.

    Of a ``closed`` one the last point is not the first again. An arc takes at most 45 % of the sides it lies between.
    """
    following = np.roll(points, -1, axis=0)
    sides = following - points if closed else (following - points)[:-1]
    lengths = np.linalg.norm(sides, axis=1)
    directions = sides / lengths[:, None]
    places, normals = [], []
    if not closed:
        places, normals = [points[:1]], [right_of(directions[:1])]
    for i in range(0 if closed else 1, len(points) if closed else len(points) - 1):
        arc = _arc(points[i], directions[i - 1], directions[i], radius, 0.45 * min(lengths[i - 1], lengths[i]))
        places.append(arc[0])
        normals.append(arc[1])
    if not closed:
        places.append(points[-1:])
        normals.append(right_of(directions[-1:]))
    return np.concatenate(places), np.concatenate(normals)


def _arc(corner: Array, incoming: Array, outgoing: Array, radius: float, longest: float) -> tuple[Array, Array]:
    turn = np.arctan2(incoming[0] * outgoing[1] - incoming[1] * outgoing[0], incoming @ outgoing)
    if abs(turn) < STRAIGHT:
        normal = right_of(incoming + outgoing)
        return corner[None], (normal / np.linalg.norm(normal))[None]
    half = np.tan(abs(turn) / 2)
    tangent = min(radius * half, longest)
    angles = np.linspace(0, turn, 1 + max(2, int(np.ceil(abs(turn) / ARC_STEP))))
    cos, sin = np.cos(angles)[:, None], np.sin(angles)[:, None]
    normals = right_of(cos * incoming + sin * np.array([-incoming[1], incoming[0]]))
    outward = np.sign(turn) * tangent / half
    centre = corner - incoming * tangent - outward * normals[0]
    return centre + outward * normals, normals


def lengths_along(points: Array) -> Array:
    """Return the length of a polyline (N, D) up to each of its points."""
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
