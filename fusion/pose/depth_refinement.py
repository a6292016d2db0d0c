"""Refinement with depth: the query's points are brought onto the model's surface (point to field).

Gauss–Newton with Levenberg–Marquardt's damping on SE(3), from few points to many, and from a robust kernel as wide as
the misfit to one as narrow as the noise. Where one start does not explain the view, more are tried, turned and shifted
about the given one, and judged both ways: the query's points in the model's field, and the model's surface against the
query.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datagen.rigid import Matrix, rigid
from fusion.pose.depth_problem import SETTLED_FLOORS, DepthProblem, depth_problem, model_noise
from fusion.pose.depth_search import better, finest, from_many, from_one, nearly
from fusion.pose.levenberg_marquardt import Descent
from fusion.pose.pose_model import PoseModel
from fusion.pose.query import MOST_POINTS, Query, query_cloud
from fusion.pose.reference_frame import ReferenceFrame
from fusion.pose.reference_shift import nearest_reference, reference_shift, without_shift
from fusion.pose.refinement import Refinement, declined
from fusion.pose.starting_poses import shifted_to_six_sides, starts_about, starts_all_about
from fusion.pose.uncertainty import uncertainty

Starts = Literal["auto", "one", "many", "here"]

FEWEST_POINTS = 60
_STEP_PX = 4
"""Every which row and column tells a view's typical depth."""
_ENOUGH, _ENOUGH_OF_A_SCENE = 0.65, 0.9
"""Share of the view that has to be explained for no other start to be tried. Of a part of a scene it is more: a pose
that slid along a floor explains much of it, too."""


@dataclass(frozen=True, kw_only=True)
class DepthRefinementOptions:
    """How a pose is refined with depth.

    ``starts``: the given pose alone, many about it, or, with auto, many only where one does not explain the view;
    ``here`` for a pose that is right but for the noise.
    Where the query's noise is more than the model's, more of its points are compared, at most ``most_points``.
    """

    starts: Starts = "auto"
    most_points: int = 4 * MOST_POINTS


def refine_with_depth(
    model: PoseModel,
    query: Query,
    world_from_camera: Matrix,
    *,
    references: Sequence[ReferenceFrame] = (),
    others: Sequence[Matrix] | None = None,
    options: DepthRefinementOptions | None = None,
) -> Refinement:
    """Refine the pose of ``query`` from the start ``world_from_camera``, which is handed back where it declines.

    Restricted to the query's mask if it has one. ``others`` are what else a search all over the model has found; None
    where there was none, and nothing is known but the start. What the nearest of ``references``, fused frames, is off
    by when it is refined likewise is taken off the pose. Residuals are metres. Raises InputError for a query without
    depth image and a start that is not rigid.
    """
    found = _refined(model, query, world_from_camera, others, options or DepthRefinementOptions())
    reference = None if found.declined else nearest_reference(references, found.world_from_camera)
    if reference is None:
        return found
    seen = Query(camera=reference.camera, depth=reference.depth)
    own = _refined(model, seen, reference.world_from_camera, None, DepthRefinementOptions(starts="here"))
    shift = reference_shift(reference, own)
    return found if shift is None else without_shift(found, shift)


def _refined(
    model: PoseModel,
    query: Query,
    world_from_camera: Matrix,
    others: Sequence[Matrix] | None,
    options: DepthRefinementOptions,
) -> Refinement:
    """Refine a pose by depth alone."""
    start = rigid(world_from_camera, source="start of the refinement")
    cloud = query_cloud(query, device=model.device, most=telling_points(model, query, most=options.most_points))
    if cloud.count < FEWEST_POINTS:
        where = "the mask" if query.mask is not None else "the image"
        reason = f"{cloud.count} pixels of {where} have a depth, fewer than the {FEWEST_POINTS} that fix a pose"
        return declined("depth", start, reason, used=cloud.count)
    problem = depth_problem(model, query, cloud, start)
    found = nearly(problem, start[None]) if options.starts == "here" else _searched(problem, start, others, options)
    return _result(problem, finest(problem, found), start)


def telling_points(model: PoseModel, query: Query, *, most: int = 4 * MOST_POINTS) -> int:
    """Return how many of a query's points tell its pose, at most ``most``.

    Noise makes a pose off by σ/√n, so that they are as many times more as σ² is times the model's. What a model is
    itself off by is alike in points next to each other, and more of them tell nothing new. Raises InputError for a
    query without depth.
    """
    depth = query.valid_depth()[::_STEP_PX, ::_STEP_PX]
    seen = depth[depth > 0]
    noise = float(query.noise(np.median(seen))) if len(seen) else 0.0
    return int(np.clip(MOST_POINTS * (noise / model_noise(model)) ** 2, min(MOST_POINTS, most), most))


def _searched(
    problem: DepthProblem, start: Matrix, others: Sequence[Matrix] | None, options: DepthRefinementOptions
) -> Descent:
    """Descend from more and more starts, until a pose explains the view."""
    elsewhere = np.array([] if others is None else others, np.float64).reshape(-1, 4, 4)
    best = None if options.starts == "many" else from_one(problem, start, elsewhere)
    if best is not None and options.starts == "one":
        return best
    enough = _ENOUGH_OF_A_SCENE if problem.is_cut else _ENOUGH
    more = _more_starts(problem, start, everywhere=others is None)
    while best is None or problem.explained(best) <= enough:
        poses = next(more, None)
        if poses is None:
            break
        found = from_many(problem, poses, best)
        spent = found.iterations + (0 if best is None else best.iterations)
        best = replace(found if best is None else better(problem, best, found), iterations=spent)
    assert best is not None
    return best


def _more_starts(problem: DepthProblem, start: Matrix, *, everywhere: bool) -> Iterator[NDArray[np.float64]]:
    """Yield poses (n, 4, 4) to start from, each time more of them; all about the start only where ``everywhere``.

    What a search all over the model has not found is not there; but in a scene a pose may have slid along what fills
    the image.
    """
    if problem.is_cut and not everywhere:
        yield shifted_to_six_sides(start[None])
        return
    points = None if problem.is_cut else problem.cloud.points_camera
    yield starts_about(problem.model, start, points)
    if everywhere:
        yield starts_all_about(problem.model, start, points)


def _result(problem: DepthProblem, found: Descent, start: Matrix) -> Refinement:
    """Return what was found, with its uncertainty, or the start where it went nowhere."""
    normals = found.normals
    if not normals.weight[0] > 0 or not np.isfinite(found.poses).all():
        return declined("depth", start, "none of the query's points comes near the model", used=problem.cloud.count)
    # The mean square of weighed residuals, which Tukey's kernel makes smaller: 0.95 of it at the noise's own scale.
    sigma = float(np.sqrt(normals.squares[0] / normals.weight[0]))
    settled = float(found.last_steps_m[0]) < SETTLED_FLOORS * problem.floor
    return Refinement(
        stage="depth",
        world_from_camera=found.poses[0],
        converged=settled,
        reason="" if settled else f"its last step was still {1000 * found.last_steps_m[0]:.2g} mm",
        residual=sigma,
        expected=problem.floor,
        inlier_share=float(normals.inliers[0]),
        overlap=float(problem.agreements(found.poses, within=problem.tolerance)[0]),
        used=problem.cloud.count,
        score=float(problem.scores(found.poses)[0]),
        iterations=found.iterations,
        uncertainty=uncertainty(
            normals.hessian[0], sigma=sigma, pivot_world=problem.pivot_world, radius_m=problem.radius
        ),
    )
