"""What fused frames tell of where the model's outline is wrong, and taking that off a query's.

A model is never quite what its frames saw: voxels round its edges, thin parts are lost between them, and what was seen
at a slant is averaged with what hid it. Where a frame's pose is known, so is what its own outline pulls it by, and a
view close to it is pulled alike. That pull, the gradient of the frame's cost at its own pose, is taken off the query's.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix, rigid
from fusion.pose.normal_equations import Normals
from fusion.pose.pose_distance import pose_distances
from fusion.pose.reference_frame import ReferenceFrame
from fusion.pose.silhouette_problem import Bias, SilhouetteProblem
from fusion.pose.silhouette_target import FINEST, outline_length, silhouette_level
from fusion.pose.uncertainty import WEAK_RATIO

NEAR = 0.1
"""Radians, a shift by the typical depth counting as one: frames farther off see other outlines."""
_MOST = 2
_LEAST_INLIERS, _WORSE = 0.9, 0.1
"""Of a frame's pixels near the outline, and how many fewer than the query's: a frame whose depth ends where the model
does not tells of its sensor."""


def without_bias(
    problem: SilhouetteProblem, references: Sequence[ReferenceFrame], world_from_camera: Matrix
) -> SilhouetteProblem:
    """Return the problem without what pulls at the poses of the references nearest to a pose.

    It is returned as it is where none of them is near, has the query's camera, or shows an outline.
    """
    camera = problem.levels[FINEST].camera
    pulls = [_pull(problem, one) for one in _near(references, camera, world_from_camera)[:_MOST]]
    shares = [float(pull.inliers[0]) for pull in pulls if pull is not None]
    least = _LEAST_INLIERS
    if shares and min(shares) < least:
        # A coarse model may be no better; then it is as bad where the query is.
        own = problem.normals(len(problem.levels) - 1, world_from_camera[None])
        least = min(least, float(own.inliers[0]) - _WORSE)
    known = [pull for pull in pulls if pull is not None and pull.inliers[0] >= least]
    if not known:
        return problem
    gradient = np.mean([pull.gradient[0] for pull in known], axis=0)
    hessian = np.mean([pull.hessian[0] for pull in known], axis=0)
    return problem.without(Bias(gradient=_where_fixed(gradient, hessian, problem.radius), anchor=world_from_camera))


def _near(
    references: Sequence[ReferenceFrame], camera: PinholeCamera, world_from_camera: Matrix
) -> list[ReferenceFrame]:
    """Return the references near a pose, the nearest first, that the same camera saw."""
    distances = []
    for reference in references:
        seen = reference.depth[np.isfinite(reference.depth) & (reference.depth > 0)]
        same = np.allclose(
            _intrinsics(reference.camera), reference.camera.width / camera.width * _intrinsics(camera), rtol=0.01
        )
        pose = np.asarray(reference.world_from_camera)[None]
        apart = pose_distances(pose, world_from_camera, depth=float(np.median(seen)))[0] if len(seen) else np.inf
        distances.append(float(apart) if same else np.inf)
    return [references[i] for i in np.argsort(distances, kind="stable") if distances[i] < NEAR]


def _intrinsics(camera: PinholeCamera) -> NDArray[np.float64]:
    return np.array([camera.fx, camera.fy])


def _pull(problem: SilhouetteProblem, reference: ReferenceFrame) -> Normals | None:
    """Return the equations of a frame's own outline at its own pose, None where it has none."""
    mask = np.isfinite(reference.depth) & (reference.depth > 0)
    if not mask.any() or outline_length(mask) == 0:
        return None
    pose = rigid(reference.world_from_camera, source="pose of a fused frame")
    level = silhouette_level(mask, reference.camera, FINEST)
    return SilhouetteProblem(problem.model, [level]).normals(0, pose[None])


def _where_fixed(gradient: NDArray[np.float64], hessian: NDArray[np.float64], radius_m: float) -> NDArray[np.float64]:
    """Return a gradient (6,) without its part along directions that an outline hardly fixes: noise moves far there."""
    scale = np.array([1, 1, 1, 1 / radius_m, 1 / radius_m, 1 / radius_m])
    values, vectors = np.linalg.eigh(scale[:, None] * hessian * scale)
    fixed = vectors[:, values * WEAK_RATIO**2 > np.sqrt(max(values[2], 0) * max(values[3], 0))]
    return np.asarray(fixed @ (fixed.T @ (scale * gradient)) / scale)
