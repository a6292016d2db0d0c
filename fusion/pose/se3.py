"""Small motions of a pose: the exponential and the logarithm of SE(3), and left perturbations about a pivot.

A twist is (v, ω): three components of translation in metres, then a rotation vector in radians. Arrays of twists or of
transforms may have leading dimensions. Formulas: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in
robotics" (2018), appendix D.
"""

import numpy as np
from numpy.typing import NDArray

_SERIES_BELOW = 1e-2
"""Angle, radians, below which the quotients of sines and cosines are taken from their series: 0/0 loses digits."""


def skew(vectors: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the matrices (…, 3, 3) that take the cross product with ``vectors`` (…, 3)."""
    v = np.asarray(vectors, dtype=np.float64)
    result = np.zeros((*v.shape[:-1], 3, 3))
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return result - np.swapaxes(result, -1, -2)


def _quotients(angle: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return sin θ/θ, (1 − cos θ)/θ² and (θ − sin θ)/θ³ for angles of any size."""
    small = angle < _SERIES_BELOW
    a = np.where(small, 1.0, angle)
    square = angle**2
    first = np.where(small, 1 - square / 6 * (1 - square / 20 * (1 - square / 42)), np.sin(a) / a)
    second = np.where(small, 0.5 - square / 24 * (1 - square / 30 * (1 - square / 56)), (1 - np.cos(a)) / a**2)
    third = np.where(small, (1 - square / 20 * (1 - square / 42)) / 6, (a - np.sin(a)) / a**3)
    return first, second, third


def exp_se3(twists: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the rigid transforms (…, 4, 4) that twists (…, 6) grow into in unit time."""
    twist = np.asarray(twists, dtype=np.float64)
    v, omega = twist[..., :3], twist[..., 3:]
    first, second, third = (q[..., None, None] for q in _quotients(np.linalg.norm(omega, axis=-1)))
    k = skew(omega)
    result = np.zeros((*twist.shape[:-1], 4, 4))
    result[..., :3, :3] = np.eye(3) + first * k + second * (k @ k)
    result[..., :3, 3] = ((np.eye(3) + second * k + third * (k @ k)) @ v[..., None])[..., 0]
    result[..., 3, 3] = 1
    return result


def log_so3(rotations: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the rotation vectors (…, 3), of length at most π, of rotation matrices (…, 3, 3).

    By way of the unit quaternion, whose largest component is taken from the diagonal, so that no angle loses digits.
    """
    r = np.asarray(rotations, dtype=np.float64)
    diagonal = np.diagonal(r, axis1=-2, axis2=-1)
    trace = diagonal.sum(axis=-1)
    # 4 q qᵀ, for q = (w, x, y, z): its longest column has the digits.
    outer = np.empty((*r.shape[:-2], 4, 4))
    outer[..., 0, 0] = 1 + trace
    for axis in range(3):
        after, before = (axis + 1) % 3, (axis + 2) % 3
        outer[..., 0, axis + 1] = outer[..., axis + 1, 0] = r[..., before, after] - r[..., after, before]
        outer[..., axis + 1, axis + 1] = 1 + 2 * diagonal[..., axis] - trace
        outer[..., after + 1, before + 1] = outer[..., before + 1, after + 1] = (
            r[..., after, before] + r[..., before, after]
        )
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-1)[..., 0]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1)
    angle = 2 * np.arctan2(sine, q[..., 0])
    # sin(θ/2) ≈ θ/2: the quotient is 2 where the angle is 0.
    return q[..., 1:] * np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1), 2.0)[..., None]


def log_se3(transforms: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the twists (…, 6) of rigid transforms (…, 4, 4), rotation at most π: the inverse of ``exp_se3``."""
    t = np.asarray(transforms, dtype=np.float64)
    omega = log_so3(t[..., :3, :3])
    _first, second, third = (q[..., None, None] for q in _quotients(np.linalg.norm(omega, axis=-1)))
    k = skew(omega)
    v = np.linalg.solve(np.eye(3) + second * k + third * (k @ k), t[..., :3, 3:])[..., 0]
    return np.concatenate([v, omega], axis=-1)


def perturb(
    twists: NDArray[np.floating], world_from_camera: NDArray[np.floating], *, pivot_world: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Move poses (…, 4, 4) by twists (…, 6) along the world's axes, turning about ``pivot_world`` (3,).

    Returns S exp(ξ) S⁻¹ · world_from_camera with S the translation to the pivot: a left perturbation, whose Jacobian of
    a point x is [1, −(x − pivot)×].
    """
    moved = exp_se3(twists)
    result = moved @ world_from_camera
    pivot = np.asarray(pivot_world, dtype=np.float64)
    result[..., :3, 3] += pivot - moved[..., :3, :3] @ pivot
    return result


def about_pivot(transform: NDArray[np.float64], pivot: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return S⁻¹ · transform (4, 4) · S, S the translation to the pivot (3,): what its twist about the pivot is of."""
    result = transform.copy()
    result[:3, 3] += transform[:3, :3] @ pivot - pivot
    return result
