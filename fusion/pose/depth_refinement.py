"""Refinement with depth: the query's points are brought onto the model's surface (point to field).

Gauss–Newton with Levenberg–Marquardt's damping on SE(3), from few points to many, and from a robust kernel as wide as
the misfit to one as narrow as the noise. Where one start does not explain the view, more are tried, turned and shifted
about the given one, and judged both ways: the query's points in the model's field, and the model's surface against the
query.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datagen.rigid import Matrix, rigid, transform_points
from fusion.pose.levenberg_marquardt import Descent, descend
from fusion.pose.normal_equations import (
    GEMAN_MCCLURE,
    INLIER_SIGMAS,
    TUKEY,
    Normals,
    Robustness,
    normal_equations,
    point_residuals,
)
from fusion.pose.pose_model import PoseModel
from fusion.pose.query import Query, QueryCloud, query_cloud
from fusion.pose.reference_frame import ReferenceFrame
from fusion.pose.reference_shift import nearest_reference, reference_shift, without_shift
from fusion.pose.refinement import Refinement, declined
from fusion.pose.starting_poses import shifted_onto_depth, starts_about
from fusion.pose.uncertainty import uncertainty
from fusion.pose.view_overlap import QueryView, agreement, overlap, query_view

Starts = Literal["auto", "one", "many", "here"]

FEWEST_POINTS = 60
_MODEL_NOISE_VOXELS = 0.12
"""Standard deviation of a fused field's distance, in voxels, of what is well seen; it is added to a point's own."""
_INLIER_VOXELS = 1.5
"""A point is an inlier within this much of the surface, or within 3.5 standard deviations where that is more: no fused
surface is to be trusted to less than a voxel everywhere."""
_TUKEY_SIGMAS = 4.685
"""Tukey's kernel of this many standard deviations has 95 % of the efficiency of least squares."""
_COARSE_POINTS, _MIDDLE_POINTS = 500, 2000
_COARSE_ROUNDS, _COARSE_STEPS, _MIDDLE_STEPS, _FINE_STEPS = 4, 4, 6, 12
_START_POINTS, _KEPT_STARTS = 300, 4
_CLEARLY = 1.03
"""By this factor a pose farther from the start has to explain the view better, lest symmetry turn the model round."""
_EXPLAINED = 0.65
"""Share of the query's points, and of the model's surface, from which on one start is enough."""


@dataclass(frozen=True, kw_only=True)
class DepthRefinementOptions:
    """How a pose is refined with depth.

    ``starts``: the given pose alone, many about it, or, with auto, many only where one does not explain the view;
    ``here`` for a pose that is right but for the noise.
    ``most_points`` of the query are compared at the finest level.
    """

    starts: Starts = "auto"
    most_points: int = 8000


@dataclass(frozen=True, kw_only=True, eq=False)
class _Problem:
    """A query against a model; lengths are metres."""

    model: PoseModel
    cloud: QueryCloud
    view: QueryView
    floor: float
    pivot_world: NDArray[np.float64]
    radius: float

    @property
    def inlier_within(self) -> float:
        """How near the surface a point without noise has to be, to count as explained."""
        return max(INLIER_SIGMAS * self.floor, _INLIER_VOXELS * self.model.voxel_size)

    @property
    def tolerance(self) -> float:
        """How far depths that agree may be apart."""
        return max(self.inlier_within, INLIER_SIGMAS * float(np.hypot(self.floor, self.cloud.sigma_median)))

    def descend(
        self, poses: NDArray[np.float64], *, count: int, kind: int, scales: NDArray[np.float64], iterations: int
    ) -> Descent:
        count = min(count, self.cloud.count)
        robustness = Robustness(kind=kind, scales=scales, floor=self.floor, inlier_within=INLIER_SIGMAS * self.floor)

        def equations(at: NDArray[np.float64]) -> Normals:
            return normal_equations(
                self.model, self.cloud, at, count=count, pivot_world=self.pivot_world, robustness=robustness
            )

        return descend(
            equations,
            poses,
            pivot_world=self.pivot_world,
            radius_m=self.radius,
            iterations=iterations,
            enough_m=1e-3 * self.floor,
        )

    def spread(self, poses: NDArray[np.float64], *, count: int) -> NDArray[np.float64]:
        """Return the robust standard deviation (n,) of the residuals that are there, at least the model's own."""
        count = min(count, self.cloud.count)
        residuals = np.abs(
            point_residuals(
                self.model, self.cloud, poses, count=count, floor=self.floor, inlier_within=self.inlier_within
            )
        )
        known = np.isfinite(residuals)
        # Where fewer than a half have a field the median is of those that have.
        residuals[~known] = np.nan
        residuals[~known.any(axis=1)] = self.radius
        return np.maximum(1.4826 * np.nanmedian(residuals, axis=1), self.floor)


def refine_with_depth(
    model: PoseModel,
    query: Query,
    world_from_camera: Matrix,
    *,
    references: Sequence[ReferenceFrame] = (),
    options: DepthRefinementOptions | None = None,
) -> Refinement:
    """Refine the pose of ``query`` from the start ``world_from_camera``, which is handed back where it declines.

    Restricted to the query's mask if it has one. What the nearest of ``references``, fused frames, is off by when it
    is refined likewise is taken off the pose. Residuals are metres. Raises InputError for a query without depth image
    and a start that is not rigid.
    """
    found = _refined(model, query, world_from_camera, options)
    reference = None if found.declined else nearest_reference(references, found.world_from_camera)
    if reference is None:
        return found
    seen = Query(camera=reference.camera, depth=reference.depth)
    own = _refined(model, seen, reference.world_from_camera, DepthRefinementOptions(starts="here"))
    shift = reference_shift(reference, own)
    return found if shift is None else without_shift(found, shift)


def _refined(
    model: PoseModel, query: Query, world_from_camera: Matrix, options: DepthRefinementOptions | None
) -> Refinement:
    """Refine a pose by depth alone."""
    options = options or DepthRefinementOptions()
    start = rigid(world_from_camera, source="start of the refinement")
    cloud = query_cloud(query, device=model.device, most=options.most_points)
    if cloud.count < FEWEST_POINTS:
        where = "the mask" if query.mask is not None else "the image"
        reason = f"{cloud.count} pixels of {where} have a depth, fewer than the {FEWEST_POINTS} that fix a pose"
        return declined("depth", start, reason, used=cloud.count)
    problem = _problem(model, query, cloud, start)
    if options.starts == "here":
        here = _fine(problem, start[None])
        return _result(problem, here, start, here.iterations)
    best, spent = (None, 0) if options.starts == "many" else _from_one(problem, start)
    if best is None or (options.starts == "auto" and not _explains(problem, best)):
        found, more = _from_many(problem, start)
        spent += more
        if best is None or _scores(problem, found.poses)[0] > _CLEARLY * _scores(problem, best.poses)[0]:
            best = found
    return _result(problem, best, start, spent)


def _problem(model: PoseModel, query: Query, cloud: QueryCloud, start: Matrix) -> _Problem:
    """Choose the pivot, in the middle of what is seen: turning and shifting about it are nearly independent there."""
    points = transform_points(start, cloud.points_camera)
    pivot = np.median(points, axis=0)
    return _Problem(
        model=model,
        cloud=cloud,
        view=query_view(query, model=model),
        floor=_MODEL_NOISE_VOXELS * model.voxel_size,
        pivot_world=pivot,
        radius=max(float(np.sqrt(((points - pivot) ** 2).sum(axis=1).mean())), 4 * model.voxel_size),
    )


def _from_one(problem: _Problem, start: Matrix) -> tuple[Descent, int]:
    """Descend from one start, coarse to fine; as it is, and shifted so that the model is where the depth is."""
    poses = np.concatenate([start[None], shifted_onto_depth(problem.model, start[None], problem.cloud.points_camera)])
    poses, spent = _coarse(problem, poses, count=_COARSE_POINTS)
    best = _fine(problem, poses[np.argmax(_scores(problem, poses))][None])
    return best, spent + best.iterations


def _coarse(problem: _Problem, poses: NDArray[np.float64], *, count: int) -> tuple[NDArray[np.float64], int]:
    """Descend with few points and a kernel that narrows as the misfit does (graduated non-convexity)."""
    spent = 0
    widest = np.full(len(poses), np.inf)
    for _round in range(_COARSE_ROUNDS):
        # Never wider than half of the last: an outlier half of the points would hold it open.
        scales = np.minimum(2 * problem.spread(poses, count=count), 0.7 * widest)
        widest = scales = np.maximum(scales, 3 * problem.floor)
        found = problem.descend(poses, count=count, kind=GEMAN_MCCLURE, scales=scales, iterations=_COARSE_STEPS)
        poses, spent = found.poses, spent + found.iterations
    return poses, spent


def _fine(problem: _Problem, poses: NDArray[np.float64]) -> Descent:
    """Descend with more points, then with all, each with the kernel that the residuals ask for."""
    spent = 0
    for count, steps in ((_MIDDLE_POINTS, _MIDDLE_STEPS), (problem.cloud.count, _FINE_STEPS)):
        scales = _TUKEY_SIGMAS * np.minimum(problem.spread(poses, count=_MIDDLE_POINTS), 10 * problem.floor)
        found = problem.descend(poses, count=count, kind=TUKEY, scales=scales, iterations=steps)
        poses, spent = found.poses, spent + found.iterations
    return replace(found, iterations=spent)


def _from_many(problem: _Problem, start: Matrix) -> tuple[Descent, int]:
    """Descend from many starts with few points, from the best of these with more, and from the best of all."""
    poses, spent = _coarse(
        problem, starts_about(problem.model, start, problem.cloud.points_camera), count=_START_POINTS
    )
    for count in (_KEPT_STARTS, 1):
        order = np.argsort(-_scores(problem, poses), kind="stable")
        poses = poses[order[:count]]
        found = problem.descend(
            poses,
            count=_MIDDLE_POINTS,
            kind=GEMAN_MCCLURE,
            scales=np.clip(2 * problem.spread(poses, count=_MIDDLE_POINTS), 3 * problem.floor, 0.05 * problem.radius),
            iterations=_MIDDLE_STEPS,
        )
        poses, spent = found.poses, spent + found.iterations
    best = _fine(problem, poses)
    return best, spent + best.iterations


def _scores(problem: _Problem, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how well poses (n, 4, 4) explain the view, from 0 to 1: the geometric mean of both ways."""
    wide = Robustness(
        kind=GEMAN_MCCLURE,
        scales=np.full(len(poses), 4 * problem.floor),
        floor=problem.floor,
        inlier_within=problem.inlier_within,
    )
    count = min(_MIDDLE_POINTS, problem.cloud.count)
    normals = normal_equations(
        problem.model, problem.cloud, poses, count=count, pivot_world=problem.pivot_world, robustness=wide
    )
    counts = overlap(problem.model, problem.view, poses, within=2 * problem.tolerance)
    return np.sqrt(np.maximum(1 - 2 * normals.cost, 0) * agreement(counts))


def _explains(problem: _Problem, found: Descent) -> bool:
    """Tell whether a descent explains the view well enough that no other start is needed."""
    counts = overlap(problem.model, problem.view, found.poses, within=2 * problem.tolerance)
    return bool(found.normals.inliers[0] > _EXPLAINED and agreement(counts)[0] > _EXPLAINED)


def _result(problem: _Problem, found: Descent, start: Matrix, spent: int) -> Refinement:
    """Return what was found, with its uncertainty, or the start where it went nowhere."""
    normals = found.normals
    if not normals.weight[0] > 0 or not np.isfinite(found.poses).all():
        return declined("depth", start, "none of the query's points comes near the model", used=problem.cloud.count)
    counts = overlap(problem.model, problem.view, found.poses, within=problem.tolerance)
    # The mean square of weighed residuals, which Tukey's kernel makes smaller: 0.95 of it at the noise's own scale.
    sigma = float(np.sqrt(normals.squares[0] / normals.weight[0]))
    settled = float(found.last_steps_m[0]) < 0.05 * problem.floor
    return Refinement(
        stage="depth",
        world_from_camera=found.poses[0],
        converged=settled,
        reason="" if settled else f"its last step was still {1000 * found.last_steps_m[0]:.2g} mm",
        residual=sigma,
        expected=problem.floor,
        inlier_share=float(normals.inliers[0]),
        overlap=float(agreement(counts)[0]),
        used=problem.cloud.count,
        score=float(_scores(problem, found.poses)[0]),
        iterations=spent,
        uncertainty=uncertainty(
            normals.hessian[0], sigma=sigma, pivot_world=problem.pivot_world, radius_m=problem.radius
        ),
    )
