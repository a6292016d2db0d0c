"""Rotations as unit quaternions, in the order that the name says: ``quat_wxyz``."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from datagen.errors import InputError
from datagen.rigid import Matrix

NORM_TOLERANCE = 1e-2
"""How far from 1 a quaternion's length may be for it to be taken as rounded; beyond it, no rotation is meant."""


def rotation_from_quat_wxyz(quat_wxyz: ArrayLike, *, source: str) -> NDArray[np.float64]:
    """Return the rotation matrix (3, 3) of a quaternion that is of unit length within rounding.

    Raises InputError, beginning with ``source``, for a length that departs from 1 by more than ``NORM_TOLERANCE``.
    """
    quat = np.asarray(quat_wxyz, dtype=np.float64)
    length = float(np.linalg.norm(quat))
    if abs(length - 1) > NORM_TOLERANCE:
        raise InputError(f"{source}: the quaternion {quat.tolist()} has length {length:.6g}, expected 1")
    w, x, y, z = quat / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quat_wxyz_from_rotation(rotation: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the unit quaternion (4,) of a rotation matrix (3, 3), its w not negative.

    Of four equivalent formulas the one that divides by the largest component is taken (Shepperd 1978), so that all
    digits are kept at every angle.
    """
    r = np.asarray(rotation, dtype=np.float64)
    trace = float(np.trace(r))
    # 4·q qᵀ of the quaternion q, row by row in the order w, x, y, z; its diagonal holds 4 w², 4 x², 4 y², 4 z².
    off = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    outer = np.empty((4, 4))
    outer[0, 0] = 1 + trace
    outer[0, 1:] = outer[1:, 0] = off
    outer[1:, 1:] = r + r.T
    np.fill_diagonal(outer[1:, 1:], 1 - trace + 2 * np.diag(r))
    row = outer[np.argmax(np.diag(outer))]
    quat = row / np.linalg.norm(row)
    return quat if quat[0] >= 0 else -quat


def pose_from_quat_wxyz(quat_wxyz: ArrayLike, translation: ArrayLike, *, source: str) -> Matrix:
    """Return the 4×4 transform of a rotation, as a quaternion, and a translation; errors as the rotation's."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_from_quat_wxyz(quat_wxyz, source=source)
    matrix[:3, 3] = translation
    return matrix
