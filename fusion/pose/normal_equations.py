"""Gauss–Newton's normal equations of points against a model's field, for many poses at once.

Each thread sums over a short run of one pose's points, in order, and the host adds the runs up in double precision:
the sums do not depend on the number of cores, nor on which of them came first.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from fusion.devices import launch_in_slabs
from fusion.pose.model_field import FieldSample, ModelField, sample_field
from fusion.pose.pose_model import PoseModel, poses_on
from fusion.pose.query import QueryCloud

wp.set_module_options({"enable_backward": False, "max_unroll": 16})

GEMAN_MCCLURE, TUKEY = 0, 1
_TUKEY = wp.constant(TUKEY)

RUN = 64
"""Points a thread."""
_RUN = wp.constant(RUN)
LEAST_SLAB = 32
"""Runs that are not worth being shared among cores."""

INLIER_SIGMAS = 3.5

SUMS = 33
"""Numbers of a run: 21 of JᵀWJ, 6 of JᵀWr, then cost, points with a field, inliers, Σw, Σw r², 1 for each point."""

Sums: Any = wp.types.vector(length=SUMS, dtype=float)

_NO_FIELD = wp.constant(0)
_FROM_GRID = wp.constant(2)
_AWAY = wp.constant(0.1)
"""Cosine from which on a surface faces away from the camera, which then cannot have seen it."""


@wp.func
def robust_weight(r: float, scale: float, kind: int) -> float:
    """Return a residual's weight: 1 at 0, and less the more of an outlier it is."""
    share = (r / scale) * (r / scale)
    if kind == _TUKEY:
        return wp.where(share < 1.0, (1.0 - share) * (1.0 - share), 0.0)
    return 1.0 / ((1.0 + share) * (1.0 + share))


@wp.func
def robust_cost(r: float, scale: float, kind: int) -> float:
    """Return the cost whose slope is weight · residual, over scale²; at most 1/6 or 1/2."""
    share = (r / scale) * (r / scale)
    if kind == _TUKEY:
        rest = 1.0 - wp.min(share, 1.0)
        return (1.0 - rest * rest * rest) / 6.0
    return 0.5 * share / (1.0 + share)


@wp.func
def add_residual(sums: Sums, r: float, weight: float, normal: wp.vec3, arm: wp.vec3) -> Sums:
    """Add one residual, with the Jacobian [n, arm × n], to the upper triangle of JᵀWJ and to JᵀWr."""
    turn = wp.cross(arm, normal)
    j = wp.spatial_vector(normal, turn)
    place = int(0)
    for row in range(6):
        wj = weight * j[row]
        for column in range(row, 6):
            sums[place] += wj * j[column]
            place += 1
        sums[21 + row] += wj * r
    sums[30] += weight
    sums[31] += weight * r * r
    return sums


@wp.func
def is_away(sample: FieldSample, ray: wp.vec3, near: float) -> bool:
    """Return whether the closest surface is one that the camera cannot have seen, since it faces away.

    At the surface itself that is not asked: on a sheet's other side both sign and normal change, and so nothing does.
    """
    return wp.abs(sample.distance) > near and wp.dot(sample.normal, ray) > _AWAY * wp.length(ray)


@wp.kernel
def accumulate(
    first: int,
    field: ModelField,
    points: wp.array(dtype=wp.vec3),
    sigmas: wp.array(dtype=float),
    count: int,
    runs: int,
    rotations: wp.array(dtype=wp.mat33),
    translations: wp.array(dtype=wp.vec3),
    idle: wp.array(dtype=int),
    pivot: wp.vec3,
    scales: wp.array(dtype=float),
    floor: float,
    kind: int,
    inlier_within: float,
    inlier_sigmas: float,
    sums: wp.array2d(dtype=float),
) -> None:
    """Sum over a run of a pose's points, for as many ``runs`` a pose; not for those that are ``idle``, not 0."""
    index = wp.tid() + first
    pose = index / runs
    if idle[pose] != 0:
        return
    run = index % runs
    rotation = rotations[pose]
    eye = translations[pose]
    scale = scales[pose]
    total = Sums()
    for i in range(run * _RUN, wp.min(run * _RUN + _RUN, count)):
        ray = rotation * points[i]
        point = ray + eye
        sample = sample_field(field, point)
        total[32] += 1.0
        away = is_away(sample, ray, inlier_within)
        if sample.source == _NO_FIELD or away:
            total[27] += wp.where(kind == _TUKEY, 1.0 / 6.0, 0.5)
        else:
            # In units of the point's own noise over the least.
            noise = wp.sqrt(1.0 + (sigmas[i] / floor) * (sigmas[i] / floor))
            r = sample.distance / noise
            total[27] += robust_cost(r, scale, kind)
            total[28] += 1.0
            if wp.abs(sample.distance) < wp.max(inlier_within, inlier_sigmas * noise * floor):
                total[29] += 1.0
            weight = robust_weight(r, scale, kind)
            if weight > 0.0:
                total = add_residual(total, r, weight, sample.normal / noise, point - pivot)
    for k in range(33):
        sums[index, k] = total[k]


@wp.kernel
def _residuals(
    first: int,
    field: ModelField,
    points: wp.array(dtype=wp.vec3),
    sigmas: wp.array(dtype=float),
    count: int,
    rotations: wp.array(dtype=wp.mat33),
    translations: wp.array(dtype=wp.vec3),
    floor: float,
    inlier_within: float,
    residuals: wp.array2d(dtype=float),
) -> None:
    index = wp.tid() + first
    pose = index / count
    i = index % count
    ray = rotations[pose] * points[i]
    sample = sample_field(field, ray + translations[pose])
    noise = wp.sqrt(1.0 + (sigmas[i] / floor) * (sigmas[i] / floor))
    away = is_away(sample, ray, inlier_within)
    residuals[pose, i] = wp.where(sample.source == _NO_FIELD or away, wp.inf, sample.distance / noise)


@dataclass(frozen=True, kw_only=True)
class Normals:
    """The normal equations of n poses, twists (v, ω) along the local axes and about the pivot.

    ``hessian`` (n, 6, 6) JᵀWJ, ``gradient`` (n, 6) JᵀWr, ``cost`` (n,) the mean robust cost of a point, over scale²;
    ``known``, ``inliers`` (n,) the shares of the points that have a field, and that lie at the surface; ``weight``
    (n,) Σw and ``squares`` (n,) Σw r². Residuals are in metres.
    """

    hessian: NDArray[np.float64]
    gradient: NDArray[np.float64]
    cost: NDArray[np.float64]
    known: NDArray[np.float64]
    inliers: NDArray[np.float64]
    weight: NDArray[np.float64]
    squares: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Robustness:
    """How residuals are weighed: ``kind`` GEMAN_MCCLURE or TUKEY, ``scales`` (n,) a pose, metres.

    A point's own noise is added to ``floor``, the model's; a point within ``inlier_within`` of the surface, or within
    3.5 standard deviations where that is more, is an inlier.
    """

    kind: int
    scales: NDArray[np.float64]
    floor: float
    inlier_within: float


def point_residuals(
    model: PoseModel, cloud: QueryCloud, poses: NDArray[np.float64], *, count: int, floor: float, inlier_within: float
) -> NDArray[np.float32]:
    """Return the distances (n, count) of the cloud's first ``count`` points, in metres of the least noise.

    ``poses`` (n, 4, 4) are world_from_camera. Infinite where the model has no field.
    """
    residuals = wp.empty((len(poses), count), dtype=float, device=model.device)
    launch_in_slabs(
        _residuals,
        dim=residuals.size,
        inputs=[
            model.field,
            cloud.points,
            cloud.sigmas,
            count,
            *poses_on(model.device, model.local(poses)),
            floor,
            inlier_within,
        ],
        outputs=[residuals],
        device=model.device,
        least_slab=512,
    )
    return residuals.numpy()


def normal_equations(
    model: PoseModel,
    cloud: QueryCloud,
    poses: NDArray[np.float64],
    *,
    count: int,
    pivot_world: NDArray[np.float64],
    robustness: Robustness,
) -> Normals:
    """Return the normal equations of the cloud's first ``count`` points at each of ``poses`` (n, 4, 4)."""
    device = model.device
    runs = -(-count // RUN)
    sums = wp.empty((len(poses) * runs, SUMS), dtype=float, device=device)
    launch_in_slabs(
        accumulate,
        dim=len(poses) * runs,
        inputs=[
            *(model.field, cloud.points, cloud.sigmas, count, runs),
            *poses_on(device, model.local(poses)),
            wp.zeros(len(poses), dtype=int, device=device),
            wp.vec3(*(pivot_world - model.origin_world).tolist()),
            wp.array(robustness.scales.astype(np.float32), dtype=float, device=device),
            *(robustness.floor, robustness.kind, robustness.inlier_within, INLIER_SIGMAS),
        ],
        outputs=[sums],
        device=device,
        least_slab=LEAST_SLAB,
    )
    return as_normals(sums.numpy().astype(np.float64).reshape(len(poses), runs, SUMS).sum(axis=1))


def as_normals(total: NDArray[np.float64]) -> Normals:
    """Return sums (n, SUMS) as equations."""
    hessian = np.zeros((len(total), 6, 6))
    rows, columns = np.triu_indices(6)
    hessian[:, rows, columns] = hessian[:, columns, rows] = total[:, :21]
    points = np.maximum(total[:, 32], 1)
    return Normals(
        hessian=hessian,
        gradient=total[:, 21:27],
        cost=total[:, 27] / points,
        known=total[:, 28] / points,
        inliers=total[:, 29] / points,
        weight=total[:, 30],
        squares=total[:, 31],
    )
