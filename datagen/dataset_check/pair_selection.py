"""Which frames to compare: pairs that see the same from clearly different places."""

import numpy as np
from numpy.typing import NDArray

LEVELS = ((5.0, 0.08), (14.0, 0.25))
"""Degrees of rotation, and translation as a share of the depth, of which a pair's motion should reach one."""

MOST_ROTATION_DEG = 35.0


def choose_pairs(poses: NDArray[np.float64], *, anchors: int, depth: float) -> NDArray[np.int64]:
    """Return pairs (b, 2) of positions in the sequence ``poses`` (n, 4, 4) world_from_camera, spread over it.

    From each of ``anchors`` frames onwards the first that has moved enough is taken, once for each of ``LEVELS``; where
    the sequence jumps about, the frame whose rotation comes closest. ``depth`` is what the scene's typically is,
    metres. Angles between frames stay the same when poses are inverted or axes flipped, so that wrong poses still give
    pairs that overlap.
    """
    count = len(poses)
    pairs = []
    for anchor in np.unique(np.linspace(0, count - 1, min(anchors, count)).round().astype(int)):
        rotation, translation = _motion_from(poses, anchor)
        for level_deg, level_depth in LEVELS:
            effort = np.maximum(rotation / level_deg, translation / (level_depth * depth))
            partner = _first_moved(effort, rotation, anchor)
            if partner is not None:
                pairs.append((int(anchor), partner))
    unique = sorted({(min(pair), max(pair)) for pair in pairs})
    return np.array([both for pair in unique for both in (pair, pair[::-1])], np.int64).reshape(-1, 2)


def _motion_from(poses: NDArray[np.float64], anchor: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    relative = poses[anchor, :3, :3].T @ poses[:, :3, :3]
    cosine = (np.trace(relative, axis1=1, axis2=2) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1))), np.linalg.norm(poses[:, :3, 3] - poses[anchor, :3, 3], axis=1)


def _first_moved(effort: NDArray[np.float64], rotation: NDArray[np.float64], anchor: int) -> int | None:
    """Return the first frame after (else before) the anchor that has moved enough and not turned away."""
    for ahead in (range(anchor + 1, len(effort)), range(anchor - 1, -1, -1)):
        for j in ahead:
            if effort[j] >= 1:
                if rotation[j] <= MOST_ROTATION_DEG:
                    return j
                break
    others = np.flatnonzero((effort > 0.2) & (rotation <= MOST_ROTATION_DEG))
    others = others[others != anchor]
    return int(others[np.abs(np.log(effort[others])).argmin()]) if others.size else None
