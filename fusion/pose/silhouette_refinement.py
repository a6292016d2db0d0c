"""Refinement by the silhouette: the model's soft outline is brought onto the query's mask.

Residuals are the differences in coverage between the model's soft silhouette and the mask blurred by the same Gaussian,
which is right to fractions of a pixel though the mask is not. From a wide blur on a small image to a narrow one at full
size, Gauss–Newton with the tape's Jacobian moves the pose on SE(3). An outline that something hides is an outlier.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datagen.rigid import Matrix, inverse, rigid, transform_points
from fusion.pose.pose_model import PoseModel
from fusion.pose.query import Query
from fusion.pose.reference_frame import ReferenceFrame
from fusion.pose.refinement import Refinement, declined
from fusion.pose.se3 import perturb
from fusion.pose.silhouette_problem import Poses, SilhouetteProblem, robust, robust_scales
from fusion.pose.silhouette_reference import without_bias
from fusion.pose.silhouette_target import Level, outline_length, silhouette_from_depth, silhouette_levels
from fusion.pose.soft_silhouette import SoftSilhouette
from fusion.pose.starting_poses import TURN_BY_OUTLINE_DEG, ring_of_turns
from fusion.pose.uncertainty import Uncertainty, clustered_uncertainty

FEWEST_PIXELS = 50
_KEPT_STARTS = 2
_GOOD_IOU = 0.9
_EDGE_NOISE_PX = 0.3
"""Standard deviation of a mask's edge, which lies anywhere between two pixels' centres: 1/√12, rounded up."""
_CLUSTERS_ACROSS = 6
"""Of the outline's box: along so much of it a mask's and a model's errors are alike."""
_SHIFTED_BY, _COMPARED_BY = 0, 1
"""Levels with all of their image's pixels: one to shift the model onto the mask, one to tell how well it fits."""


@dataclass(frozen=True, kw_only=True)
class SilhouetteRefinementOptions:
    """How a pose is refined by the silhouette.

    ``starts``: the given pose alone, many turned about it, or, with auto, many only where one does not fit.
    """

    starts: Literal["auto", "one", "many"] = "auto"


def refine_with_silhouette(
    model: PoseModel,
    query: Query,
    world_from_camera: Matrix,
    *,
    references: Sequence[ReferenceFrame] = (),
    options: SilhouetteRefinementOptions | None = None,
) -> Refinement:
    """Refine the pose of ``query`` from the start ``world_from_camera`` by its mask, or the one that its depth tells.

    What the model's outline is off by is told by the frames nearest to the view that are among ``references``.

    Residuals are pixels of the query's image; ``overlap`` is the masks' intersection over union. Where it declines, the
    start is handed back. Raises InputError for a start that is not rigid.
    """
    options = options or SilhouetteRefinementOptions()
    start = rigid(world_from_camera, source="start of the refinement")
    mask = query.mask if query.mask is not None else silhouette_from_depth(model, query, start)
    if mask is None:
        return declined("silhouette", start, "the query has neither a mask nor a depth that tells one", unit="px")
    count = int(mask.sum())
    if count < FEWEST_PIXELS:
        reason = f"the mask has {count} pixels, fewer than the {FEWEST_PIXELS} that make an outline"
        return declined("silhouette", start, reason, used=count, unit="px")
    if outline_length(mask) < FEWEST_PIXELS:
        return declined("silhouette", start, "the mask's outline is not in the image", used=count, unit="px")
    problem = SilhouetteProblem(model, silhouette_levels(mask, query.camera))
    best: _Found | None = None
    if options.starts != "many":
        best = _from_one(problem, start, references)
    if best is None or (options.starts == "auto" and best.overlap < _GOOD_IOU):
        found = _from_many(problem, start, references)
        best = found if best is None or found.overlap > best.overlap + 0.01 else best
    return _result(problem, best, start, px_a_level_px=query.camera.fx / problem.levels[-1].camera.fx)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Found:
    """Where a start led to: the overlap of the silhouettes, the pose, the iterations and the last step, metres."""

    overlap: float
    pose: Matrix
    iterations: int
    last_step_m: float


def _from_one(problem: SilhouetteProblem, start: Matrix, references: Sequence[ReferenceFrame]) -> _Found:
    poses = start[None]
    if problem.overlaps(_SHIFTED_BY, poses)[0] < 0.5:
        poses = _shifted_onto_mask(problem, poses)
    return _through_levels(problem, poses, references)


def _from_many(problem: SilhouetteProblem, start: Matrix, references: Sequence[ReferenceFrame]) -> _Found:
    """Descend the coarsest level from many starts, and all levels from the best of them."""
    shifted = _shifted_onto_mask(problem, start[None])[0]
    poses = perturb(ring_of_turns(TURN_BY_OUTLINE_DEG), shifted, pivot_world=problem.pivot_world)
    poses = problem.descend(_SHIFTED_BY, _shifted_onto_mask(problem, poses)).poses
    order = np.argsort(-problem.overlaps(_COMPARED_BY, poses), kind="stable")
    return _through_levels(problem, poses[order[:_KEPT_STARTS]], references)


def _through_levels(problem: SilhouetteProblem, poses: Poses, references: Sequence[ReferenceFrame]) -> _Found:
    """Descend poses (k, 4, 4) through all levels; returns the one that fits best."""
    spent = 0
    for number in range(len(problem.levels)):
        if number == len(problem.levels) - 1:
            problem = without_bias(problem, references, poses[0])
        descent = problem.descend(number, poses)
        poses, spent = descent.poses, spent + descent.iterations
    overlaps = problem.overlaps(_COMPARED_BY, poses)
    best = int(overlaps.argmax())
    return _Found(
        overlap=float(overlaps[best]),
        pose=poses[best],
        iterations=spent,
        last_step_m=float(descent.last_steps_m[best]),
    )


def _shifted_onto_mask(problem: SilhouetteProblem, poses: Poses) -> Poses:
    """Shift the cameras (k, 4, 4) so that the silhouette's middle and area become the mask's."""
    level = problem.levels[_SHIFTED_BY]
    for _step in range(2):
        coverage = problem.see(_SHIFTED_BY, poses).coverage
        poses = np.stack([_shifted(problem, level, *one) for one in zip(poses, coverage, strict=True)])
    return poses


def _shifted(problem: SilhouetteProblem, level: Level, pose: Matrix, covered: NDArray[np.float64]) -> Matrix:
    """Return a pose shifted by what the pixels that it covers (n,) are off the mask."""
    middle_camera = transform_points(inverse(pose), problem.pivot_world)
    target = np.average(level.pixels, axis=0, weights=level.target)
    camera = level.camera
    if covered.sum() < 1 or middle_camera[2] <= 0:
        # The model is not in the image: its middle goes onto the mask's, as far away as it is.
        seen, zoom = camera.project(np.array([0.0, 0.0, 1.0])), 1.0
        middle_camera = np.array([0.0, 0.0, np.linalg.norm(middle_camera)])
    else:
        seen = np.average(level.pixels, axis=0, weights=covered)
        zoom = float(np.clip(np.sqrt(covered.sum() / level.target.sum()), 0.5, 2.0))
    z = middle_camera[2]
    wanted = middle_camera * zoom
    wanted[:2] += (target - seen) * z * zoom / np.array([camera.fx, camera.fy])
    moved = pose.copy()
    moved[:3, 3] = problem.pivot_world - pose[:3, :3] @ wanted
    return moved


def _result(problem: SilhouetteProblem, best: _Found, start: Matrix, *, px_a_level_px: float) -> Refinement:
    """Return what was found; a pixel of the finest level is ``px_a_level_px`` of the query's."""
    level = problem.levels[-1]
    seen = problem.see(len(problem.levels) - 1, best.pose[None], with_jacobian=True)
    at_edge = (level.target > 0.1) & (level.target < 0.9)
    # Coverage changes by 1/(σ √2π) a pixel at the edge.
    off_px = (seen.coverage[0] - level.target) * level.softness_px * np.sqrt(2 * np.pi) * px_a_level_px
    near = np.abs(off_px[at_edge]) < px_a_level_px
    if not near.any() or not np.isfinite(best.pose).all():
        reason = "the model's outline does not come near the mask's"
        return declined("silhouette", start, reason, used=len(level.pixels), unit="px")
    settled = best.last_step_m < 1e-3 * problem.model.diameter
    return Refinement(
        stage="silhouette",
        world_from_camera=best.pose,
        converged=settled,
        reason="" if settled else f"its last step was still {1000 * best.last_step_m:.2g} mm",
        residual=float(np.sqrt(np.mean(off_px[at_edge][near] ** 2))),
        expected=_EDGE_NOISE_PX,
        unit="px",
        inlier_share=float(near.mean()),
        overlap=best.overlap,
        used=len(level.pixels),
        iterations=best.iterations,
        uncertainty=_uncertainty(problem, level, seen),
    )


def _uncertainty(problem: SilhouetteProblem, level: Level, seen: SoftSilhouette) -> Uncertainty:
    """Return how well an outline fixes the pose; what tells of the same piece of the outline errs alike."""
    assert seen.jacobian is not None
    residuals = seen.coverage - level.target
    share = ((residuals / robust_scales(residuals)) ** 2)[0]
    side = max(float(np.sqrt(np.prod(np.ptp(level.pixels, axis=0) + 1))) / _CLUSTERS_ACROSS, 1.0)
    cells = np.floor((level.pixels - level.pixels.min(axis=0)) / side).astype(np.int64)
    return clustered_uncertainty(
        seen.jacobian[0],
        residuals[0],
        robust(residuals)[0][0],
        cells @ np.array([1, 10_000]),
        pivot_world=problem.pivot_world,
        radius_m=problem.radius,
        bends=(1 - 3 * share) / (1 + share) ** 3,
    )
