"""Levenberg and Marquardt's damped steps on SE(3) by depth, for many poses side by side, without leaving the device.

An iteration is three launches: points are compared with the model's field, run by run; the runs are added up; and each
pose takes its step, or takes it back and is damped more. Nothing is waited for but the flags that say which poses have
arrived, and those cost nothing from then on. Poses are kept in double precision.
"""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from fusion.devices import Device, SlabLaunch
from fusion.pose.cholesky import Sums64, place_in_upper, solve_symmetric
from fusion.pose.levenberg_marquardt import Descent
from fusion.pose.normal_equations import (
    INLIER_SIGMAS,
    LEAST_SLAB,
    RUN,
    SUMS,
    Normals,
    accumulate,
    as_normals,
)
from fusion.pose.pose_model import PoseModel
from fusion.pose.query import QueryCloud

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_FIRST_DAMPING = 1e-3
_LEAST_DAMPING, _MOST_DAMPING = wp.constant(wp.float64(1e-9)), wp.constant(wp.float64(1e6))
_LESS, _MORE = wp.constant(wp.float64(5.0)), wp.constant(wp.float64(8.0))
"""How much the damping changes by, after a step that was good and one that was not."""
_LONGEST_TURN = wp.constant(wp.float64(0.35))
"""Radians a step: the linearisation of a rotation holds no farther."""

_TERMS = wp.constant(14)
"""Of a sine's series after its first: up to half a turn, the next is less than 1e-16."""

_SUMS = wp.constant(SUMS)


@wp.struct
class Travellers:
    """Poses on their way, on a device, and what they have found: local_from_camera in double precision.

    ``rotations``, ``translations`` (n,) are where poses are, ``next_rotations``, ``next_translations`` where they look
    next, of which ``rotations_there``, ``translations_there`` are the rounded values that points are moved by. ``here``
    and ``there`` (n, SUMS) are the sums of ``normal_equations`` at these two; ``dampings`` (n,), the lengths of the
    steps to where they look and of the last steps taken (n,), and which of them have ``arrived`` (n,), 1.
    """

    rotations: wp.array(dtype=wp.mat33d)
    translations: wp.array(dtype=wp.vec3d)
    next_rotations: wp.array(dtype=wp.mat33d)
    next_translations: wp.array(dtype=wp.vec3d)
    rotations_there: wp.array(dtype=wp.mat33)
    translations_there: wp.array(dtype=wp.vec3)
    here: wp.array2d(dtype=wp.float64)
    there: wp.array2d(dtype=wp.float64)
    dampings: wp.array(dtype=wp.float64)
    lengths: wp.array(dtype=wp.float64)
    last_steps: wp.array(dtype=wp.float64)
    arrived: wp.array(dtype=int)


@wp.struct
class Steps:
    """How steps are taken: turned about ``pivot``, local metres; points lie within ``radius`` of it, about.

    A step shorter than ``sure`` is taken though the cost rises, and one shorter than ``enough`` is the last.
    """

    pivot: wp.vec3d
    radius: wp.float64
    enough: wp.float64
    sure: wp.float64


@wp.kernel
def _add_runs(
    sums: wp.array2d(dtype=float), runs: int, arrived: wp.array(dtype=int), totals: wp.array2d(dtype=wp.float64)
) -> None:
    index = wp.tid()
    pose = index / _SUMS
    k = index % _SUMS
    if arrived[pose] != 0:
        return
    total = wp.float64(0.0)
    for run in range(runs):
        total += wp.float64(sums[pose * runs + run, k])
    totals[pose, k] = total


@wp.func
def damped_step(sums: Sums64, damping: wp.float64, radius: wp.float64) -> wp.spatial_vectord:
    """Return the twist that solves (H + λ diag H) ξ = −g, no longer than the linearisation holds."""
    one = wp.float64(1.0)
    scale = wp.spatial_vectord(one, one, one, one / radius, one / radius, one / radius)
    scaled = Sums64()
    mean = wp.float64(0.0)
    for row in range(6):
        for column in range(row, 6):
            place = place_in_upper(row, column)
            scaled[place] = scale[row] * sums[place] * scale[column]
        mean += scaled[place_in_upper(row, row)] / wp.float64(6.0)
        scaled[21 + row] = scale[row] * sums[21 + row]
    # A direction that nothing fixes must not be stepped along: it gets a share of what the others have.
    least = wp.float64(1e-9) * mean + wp.float64(1e-300)
    for row in range(6):
        place = place_in_upper(row, row)
        scaled[place] += damping * (scaled[place] + wp.float64(1e-3) * mean) + least
    twist = wp.cw_mul(scale, solve_symmetric(scaled, wp.float64(0.0)))
    turn = wp.length(wp.spatial_bottom(twist))
    shift = wp.length(wp.spatial_top(twist))
    return twist / wp.max(wp.max(turn, shift / (wp.float64(2.0) * radius)) / _LONGEST_TURN, one)


@wp.func
def _from_term(first: int, square: wp.float64) -> wp.float64:
    """Return the sum of (−square)ʲ / (first + 2 j)!, which needs no sine; exact up to half a turn."""
    one = wp.float64(1.0)
    total = one
    for back in range(_TERMS):
        last = first + 2 * (_TERMS - back)
        total = one - square / wp.float64((last - 1) * last) * total
    for factor in range(2, first + 1):
        total /= wp.float64(factor)
    return total


@wp.func
def exponential_of(turn: wp.vec3d) -> wp.mat33d:
    """Return the rotation by the vector ``turn`` (Rodrigues 1840)."""
    square = wp.dot(turn, turn)
    k = wp.skew(turn)
    return wp.identity(n=3, dtype=wp.float64) + _from_term(1, square) * k + _from_term(2, square) * (k * k)


@wp.func
def left_jacobian(turn: wp.vec3d) -> wp.mat33d:
    """Return the matrix that takes a twist's v to the translation of its exponential (Solà and others 2018)."""
    square = wp.dot(turn, turn)
    k = wp.skew(turn)
    return wp.identity(n=3, dtype=wp.float64) + _from_term(2, square) * k + _from_term(3, square) * (k * k)


@wp.kernel
def _step(poses: Travellers, steps: Steps) -> None:
    index = wp.tid()
    if poses.arrived[index] != 0:
        return
    length = poses.lengths[index]
    # Costs are sums over equally many points. What has not been anywhere yet comes from an infinite cost.
    if poses.there[index, 27] <= poses.here[index, 27] or length < steps.sure:
        for k in range(_SUMS):
            poses.here[index, k] = poses.there[index, k]
        poses.rotations[index] = poses.next_rotations[index]
        poses.translations[index] = poses.next_translations[index]
        poses.last_steps[index] = length
        poses.dampings[index] = wp.max(poses.dampings[index] / _LESS, _LEAST_DAMPING)
    else:
        poses.last_steps[index] = wp.min(poses.last_steps[index], length)
        poses.dampings[index] = wp.min(poses.dampings[index] * _MORE, _MOST_DAMPING)
    if length < steps.enough:
        poses.arrived[index] = 1
        return
    sums = Sums64()
    for k in range(_SUMS):
        sums[k] = poses.here[index, k]
    twist = damped_step(sums, poses.dampings[index], steps.radius)
    shift = wp.spatial_top(twist)
    turn = wp.spatial_bottom(twist)
    moved = exponential_of(turn)
    rotation = moved * poses.rotations[index]
    translation = moved * (poses.translations[index] - steps.pivot) + steps.pivot + left_jacobian(turn) * shift
    poses.next_rotations[index] = rotation
    poses.next_translations[index] = translation
    poses.rotations_there[index] = wp.mat33(rotation)
    poses.translations_there[index] = wp.vec3(translation)
    poses.lengths[index] = wp.max(wp.length(shift), steps.radius * wp.length(turn))


class DepthDescent:
    """Descents of ``poses`` poses at once by the first ``count`` points of a cloud, in arrays that are kept.

    Lengths are metres: poses turn about ``pivot_world``, from which points lie ``radius_m`` away; ``floor`` is that of
    ``Robustness``, ``enough_m`` and ``sure_m`` those of ``Steps``.
    """

    def __init__(
        self,
        model: PoseModel,
        cloud: QueryCloud,
        *,
        poses: int,
        count: int,
        pivot_world: NDArray[np.float64],
        radius_m: float,
        floor: float,
        enough_m: float,
        sure_m: float,
    ) -> None:
        self._model, self._at = model, _travellers(poses, model.device)
        self._scales = wp.zeros(poses, dtype=float, device=model.device)
        steps, pivot = Steps(), (pivot_world - model.origin_world).tolist()
        steps.pivot, steps.radius, steps.enough, steps.sure = wp.vec3d(*pivot), radius_m, enough_m, sure_m
        runs = -(-count // RUN)
        sums = wp.empty((poses * runs, SUMS), dtype=float, device=model.device)
        at = self._at
        self._inputs = [
            *(model.field, cloud.points, cloud.sigmas, count, runs),
            *(at.rotations_there, at.translations_there, at.arrived),
            *(wp.vec3(*pivot), self._scales, floor),
        ]
        self._dim, self._sums, self._floor = len(sums), sums, floor
        self._accumulate: dict[int, SlabLaunch] = {}
        record = {"device": model.device, "record_cmd": True}
        self._add = wp.launch(
            _add_runs, dim=poses * SUMS, inputs=[sums, runs, at.arrived], outputs=[at.there], **record
        )
        self._step = wp.launch(_step, dim=poses, inputs=[at, steps], **record)

    def evaluate(self, poses: NDArray[np.float64], *, kind: int, scales: NDArray[np.float64]) -> Normals:
        """Return the normal equations at poses (n, 4, 4), world_from_camera, as ``normal_equations`` does."""
        self._start(poses, scales)
        self._look(kind)
        return as_normals(self._at.there.numpy().copy())

    def descend(
        self, poses: NDArray[np.float64], *, kind: int, scales: NDArray[np.float64], iterations: int
    ) -> Descent:
        """Move poses (n, 4, 4), world_from_camera, downhill by robust kernels of ``scales`` (n,)."""
        self._start(poses, scales)
        done = 0
        self._look(kind)
        self._step.launch()
        while done < iterations and not self._at.arrived.numpy().all():
            done += 1
            self._look(kind)
            self._step.launch()
        found = np.tile(np.eye(4), (len(poses), 1, 1))
        found[:, :3, :3] = self._at.rotations.numpy()
        found[:, :3, 3] = self._at.translations.numpy() + self._model.origin_world
        return Descent(
            poses=found,
            normals=as_normals(self._at.here.numpy().copy()),
            iterations=done,
            last_steps_m=self._at.last_steps.numpy().copy(),
        )

    def _start(self, poses: NDArray[np.float64], scales: NDArray[np.float64]) -> None:
        at, local = self._at, self._model.local(poses)
        at.rotations_there.assign(local[:, :3, :3].astype(np.float32))
        at.translations_there.assign(local[:, :3, 3].astype(np.float32))
        at.next_rotations.assign(local[:, :3, :3])
        at.next_translations.assign(local[:, :3, 3])
        at.here.fill_(np.inf)
        # The first evaluation counts as a good step, which lessens the damping.
        at.dampings.fill_(_FIRST_DAMPING * float(_LESS))
        at.lengths.fill_(np.inf)
        at.last_steps.fill_(np.inf)
        at.arrived.zero_()
        self._scales.assign(scales.astype(np.float32))

    def _look(self, kind: int) -> None:
        """Sum up the equations of where the poses look."""
        if kind not in self._accumulate:
            within = INLIER_SIGMAS * self._floor
            self._accumulate[kind] = SlabLaunch(
                accumulate,
                dim=self._dim,
                inputs=[*self._inputs, kind, within, INLIER_SIGMAS],
                outputs=[self._sums],
                device=self._model.device,
                least_slab=LEAST_SLAB,
            )
        self._accumulate[kind].run()
        self._add.launch()


def _travellers(count: int, device: Device) -> Travellers:
    """Return arrays for ``count`` poses, with nothing in them."""
    at = Travellers()
    for name in ("rotations", "next_rotations"):
        setattr(at, name, wp.zeros(count, dtype=wp.mat33d, device=device))
    for name in ("translations", "next_translations"):
        setattr(at, name, wp.zeros(count, dtype=wp.vec3d, device=device))
    at.rotations_there = wp.zeros(count, dtype=wp.mat33, device=device)
    at.translations_there = wp.zeros(count, dtype=wp.vec3, device=device)
    for name in ("here", "there"):
        setattr(at, name, wp.zeros((count, SUMS), dtype=wp.float64, device=device))
    for name in ("dampings", "lengths", "last_steps"):
        setattr(at, name, wp.zeros(count, dtype=wp.float64, device=device))
    at.arrived = wp.zeros(count, dtype=int, device=device)
    return at
