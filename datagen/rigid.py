"""Rigid transforms: 4×4 matrices named ``target_from_source``."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from datagen.errors import InputError

Matrix = NDArray[np.float64]

RIGID_TOLERANCE = 1e-3
"""Largest entry of RᵀR − I that is taken for rounding and mended; beyond it a rotation is refused."""


class NotRigidError(InputError):
    """A rotation with scale, shear or reflection; ``is_reflection`` where it is orthonormal but mirrors."""

    def __init__(self, message: str, *, is_reflection: bool) -> None:
        super().__init__(message)
        self.is_reflection = is_reflection


def rigid(matrix: ArrayLike, *, source: str) -> Matrix:
    """Return ``matrix`` as an exactly rigid 4×4 transform, float64.

    A rotation within ``RIGID_TOLERANCE`` of orthonormal is replaced by the nearest one (the orthogonal polar factor).
    Raises InputError, beginning with ``source``, for a wrong shape, a NaN or infinite entry, a last row other than
    0 0 0 1, and NotRigidError for a scale, a shear or a reflection.
    """
    candidate = np.asarray(matrix, dtype=np.float64)
    if candidate.shape != (4, 4):
        raise InputError(f"{source}: a pose is a 4×4 matrix, found shape {candidate.shape}")
    if not np.isfinite(candidate).all():
        raise InputError(
            f"{source}: the pose holds NaN or infinity; tracking was probably lost here, leave this frame out"
        )
    if np.abs(candidate[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise InputError(
            f"{source}: the pose's last row is {candidate[3].tolist()}, expected 0 0 0 1; "
            "a transposed matrix would explain it"
        )
    rotation = candidate[:3, :3]
    departure = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if departure > RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
        raise NotRigidError(
            f"{source}: the pose is not rigid: its rotation departs from orthonormal by {departure:.3g} "
            f"(at most {RIGID_TOLERANCE:g}) and has determinant {np.linalg.det(rotation):.6g} (expected 1); "
            "remove scale, shear and reflection",
            is_reflection=departure <= RIGID_TOLERANCE,
        )
    left, _, right = np.linalg.svd(rotation)
    result = np.eye(4)
    result[:3, :3] = left @ right
    result[:3, 3] = candidate[:3, 3]
    return result


def inverse(target_from_source: Matrix) -> Matrix:
    """Return ``source_from_target`` of a rigid transform (4, 4), or of each of several (…, 4, 4)."""
    rotation = np.swapaxes(target_from_source[..., :3, :3], -1, -2)
    source_from_target = np.zeros(target_from_source.shape)
    source_from_target[..., :3, :3] = rotation
    source_from_target[..., :3, 3:] = -rotation @ target_from_source[..., :3, 3:]
    source_from_target[..., 3, 3] = 1.0
    return source_from_target


def transform_points(target_from_source: Matrix, points_source: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return points (…, 3) given in the source frame in the target frame."""
    return points_source @ target_from_source[:3, :3].T + target_from_source[:3, 3]


def rotation_angle_deg(a_from_b: Matrix) -> float:
    """Return the angle in degrees of a transform's rotation, in [0, 180].

    From sine and cosine together (the axis' length and the trace), so that angles near 0 and 180 keep their digits.
    """
    rotation = a_from_b[:3, :3]
    axis = (
        rotation[2, 1] - rotation[1, 2],
        rotation[0, 2] - rotation[2, 0],
        rotation[1, 0] - rotation[0, 1],
    )
    return float(np.degrees(np.arctan2(np.linalg.norm(axis), np.trace(rotation) - 1)))


def look_at(position: ArrayLike, target: ArrayLike, *, up: ArrayLike = (0, 0, 1)) -> Matrix:
    """Return world_from_camera of a camera at ``position`` that sees ``target`` in its centre, OpenCV axes.

    ``up`` is the world direction that appears upwards (image −y). Raises InputError where the view is along it.
    """
    forward = np.subtract(target, position).astype(np.float64)
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if np.linalg.norm(right) <= 1e-9 * np.linalg.norm(forward) * np.linalg.norm(up):
        raise InputError(f"look_at: the view from {position!r} to {target!r} is along the up direction {up!r}")
    forward /= np.linalg.norm(forward)
    right /= np.linalg.norm(right)
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    world_from_camera[:3, 3] = position
    return world_from_camera
