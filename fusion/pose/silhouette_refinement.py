"""Refinement by the silhouette: the model's soft outline is brought onto the query's mask.

Residuals are the differences in coverage between the model's soft silhouette and the mask blurred by the same Gaussian,
which is right to fractions of a pixel though the mask is not. From a wide blur on a small image to a narrow one at full
size, Gauss–Newton with the tape's Jacobian moves the pose on SE(3). An outline that something hides is an outlier.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix, inverse, rigid, transform_points
from fusion.pose.levenberg_marquardt import Descent, descend
from fusion.pose.normal_equations import Normals
from fusion.pose.pose_model import PoseModel
from fusion.pose.query import Query
from fusion.pose.refinement import Refinement, declined
from fusion.pose.se3 import perturb
from fusion.pose.silhouette_target import Level, outline_length, silhouette_from_depth, silhouette_levels
from fusion.pose.soft_silhouette import soft_silhouette
from fusion.pose.starting_poses import TURN_BY_OUTLINE_DEG, ring_of_turns
from fusion.pose.uncertainty import uncertainty

FEWEST_PIXELS = 50
_LEAST_COVERAGE_SPREAD = 0.02
"""Coverage of a pixel is not known better than this: the mask is made of whole pixels."""
_KEPT_STARTS = 2
_GOOD_IOU = 0.9
_EDGE_NOISE_PX = 0.3
"""Standard deviation of a mask's edge, which lies anywhere between two pixels' centres: 1/√12, rounded up."""


@dataclass(frozen=True, kw_only=True)
class SilhouetteRefinementOptions:
    """How a pose is refined by the silhouette.

    ``starts``: the given pose alone, many turned about it, or, with auto, many only where one does not fit.
    """

    starts: Literal["auto", "one", "many"] = "auto"


@dataclass(frozen=True, kw_only=True, eq=False)
class _Problem:
    """A mask against a model, with the point that the pose turns about and the model's size, metres."""

    model: PoseModel
    mask: NDArray[np.bool_]
    camera: PinholeCamera
    pivot_world: NDArray[np.float64]
    radius: float

    def normals(self, level: Level, pose: Matrix) -> Normals:
        """Return the normal equations of one pose; residuals are shares of coverage."""
        seen = soft_silhouette(
            self.model,
            level.camera,
            level.pixels,
            pose,
            softness_px=level.softness_px,
            pivot_world=self.pivot_world,
        )
        residuals = seen.coverage - level.target
        # Geman and McClure's kernel: an edge that is off by more than about σ counts less and less.
        scale = max(0.4, 2 * float(np.sqrt(np.mean(residuals**2))))
        share = (residuals / scale) ** 2
        weights = 1 / (1 + share) ** 2
        weighted = weights[:, None] * seen.jacobian
        return Normals(
            hessian=(weighted.T @ seen.jacobian)[None],
            gradient=(weighted.T @ residuals)[None],
            cost=np.array([float(np.mean(0.5 * scale**2 * share / (1 + share)))]),
            known=np.array([float(np.isfinite(seen.edge_px).mean())]),
            inliers=np.array([float((np.abs(residuals) < 0.25).mean())]),
            weight=np.array([float(weights.sum())]),
            squares=np.array([float((weights * residuals**2).sum())]),
        )

    def descend(self, level: Level, pose: Matrix) -> Descent:
        return descend(
            lambda poses: self.normals(level, poses[0]),
            pose[None],
            pivot_world=self.pivot_world,
            radius_m=self.radius,
            iterations=level.iterations,
            enough_m=level.enough * self.model.diameter,
        )


def refine_with_silhouette(
    model: PoseModel,
    query: Query,
    world_from_camera: Matrix,
    *,
    options: SilhouetteRefinementOptions | None = None,
) -> Refinement:
    """Refine the pose of ``query`` from the start ``world_from_camera`` by its mask, or the one that its depth tells.

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
    problem = _Problem(
        model=model,
        mask=mask,
        camera=query.camera,
        pivot_world=model.centre_world,
        radius=0.3 * model.diameter,
    )
    levels = silhouette_levels(mask, query.camera)
    best: tuple[float, Matrix, Descent] | None = None
    if options.starts != "many":
        best = _from_one(problem, levels, start)
    if best is None or (options.starts == "auto" and best[0] < _GOOD_IOU):
        found = _from_many(problem, levels, start)
        best = found if best is None or found[0] > best[0] + 0.01 else best
    return _result(problem, levels[-1], best, start)


def _from_one(problem: _Problem, levels: list[Level], start: Matrix) -> tuple[float, Matrix, Descent]:
    """Descend through all levels; returns the overlap, the pose and the last descent."""
    pose = start
    if _overlap(problem, levels[0], pose) < 0.5:
        pose = _shifted_onto_mask(problem, levels[0], pose)
    spent = 0
    for level in levels:
        found = problem.descend(level, pose)
        pose, spent = found.poses[0], spent + found.iterations
    return _overlap(problem, levels[1], pose), pose, replace(found, iterations=spent)


def _from_many(problem: _Problem, levels: list[Level], start: Matrix) -> tuple[float, Matrix, Descent]:
    """Descend the coarse levels from many starts, and all levels from the best of them."""
    twists = ring_of_turns(TURN_BY_OUTLINE_DEG)
    shifted = _shifted_onto_mask(problem, levels[0], start)
    candidates = []
    for pose in perturb(twists, shifted, pivot_world=problem.pivot_world):
        found = problem.descend(levels[0], _shifted_onto_mask(problem, levels[0], pose))
        candidates.append((_overlap(problem, levels[1], found.poses[0]), found.poses[0]))
    candidates.sort(key=lambda candidate: -candidate[0])
    return max((_from_one(problem, levels, pose) for _, pose in candidates[:_KEPT_STARTS]), key=lambda found: found[0])


def _coverage(problem: _Problem, level: Level, pose: Matrix) -> NDArray[np.float64]:
    return soft_silhouette(
        problem.model,
        level.camera,
        level.pixels,
        pose,
        softness_px=level.softness_px,
        pivot_world=problem.pivot_world,
        with_jacobian=False,
    ).coverage


def _overlap(problem: _Problem, level: Level, pose: Matrix) -> float:
    """Return the intersection over union of the silhouettes at a level that has all pixels."""
    ours, theirs = _coverage(problem, level, pose) > 0.5, level.target > 0.5
    return float((ours & theirs).sum() / max((ours | theirs).sum(), 1))


def _shifted_onto_mask(problem: _Problem, level: Level, pose: Matrix) -> Matrix:
    """Shift the camera so that the silhouette's middle and area become the mask's."""
    for _step in range(2):
        covered = _coverage(problem, level, pose)
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
        pose = moved
    return pose


def _result(problem: _Problem, level: Level, best: tuple[float, Matrix, Descent], start: Matrix) -> Refinement:
    """Return what was found, with its uncertainty in pixels of the finest level."""
    overlap, pose, found = best
    seen = soft_silhouette(
        problem.model,
        level.camera,
        level.pixels,
        pose,
        softness_px=level.softness_px,
        pivot_world=problem.pivot_world,
        with_jacobian=False,
    )
    step = problem.camera.fx / level.camera.fx
    at_edge = (level.target > 0.1) & (level.target < 0.9)
    # Coverage changes by 1/(σ √2π) a pixel at the edge.
    off_px = (seen.coverage - level.target) * level.softness_px * np.sqrt(2 * np.pi) * step
    near = np.abs(off_px[at_edge]) < step
    if not near.any() or not np.isfinite(pose).all():
        reason = "the model's outline does not come near the mask's"
        return declined("silhouette", start, reason, used=len(level.pixels), unit="px")
    residual = float(np.sqrt(np.mean(off_px[at_edge][near] ** 2)))
    settled = float(found.last_steps_m[0]) < 1e-3 * problem.model.diameter
    spread = max(float(np.sqrt(found.normals.squares[0] / found.normals.weight[0])), _LEAST_COVERAGE_SPREAD)
    return Refinement(
        stage="silhouette",
        world_from_camera=pose,
        converged=settled,
        reason="" if settled else f"its last step was still {1000 * found.last_steps_m[0]:.2g} mm",
        residual=residual,
        expected=_EDGE_NOISE_PX,
        unit="px",
        inlier_share=float(near.mean()),
        overlap=overlap,
        used=len(level.pixels),
        iterations=found.iterations,
        uncertainty=uncertainty(
            found.normals.hessian[0], sigma=spread, pivot_world=problem.pivot_world, radius_m=problem.radius
        ),
    )
