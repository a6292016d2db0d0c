"""A query's depth against a model, as a refinement by depth asks of it: residuals, descents, and how good a pose is.

A pose is judged both ways: the query's points in the model's field, and the model's surface against the query.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix, inverse, transform_points
from fusion.pose.depth_descent import DepthDescent
from fusion.pose.levenberg_marquardt import Descent
from fusion.pose.normal_equations import (
    GEMAN_MCCLURE,
    INLIER_SIGMAS,
    Robustness,
    normal_equations,
    point_residuals,
)
from fusion.pose.pose_model import PoseModel
from fusion.pose.query import Query, QueryCloud
from fusion.pose.se3 import log_so3
from fusion.pose.view_overlap import QueryView, agreement, overlap, query_view

MIDDLE_POINTS = 2000
_MODEL_NOISE_VOXELS = 0.12
"""Standard deviation of a fused field's distance, in voxels, of what is well seen; it is added to a point's own."""
_INLIER_VOXELS = 1.5
"""A point is an inlier within this much of the surface, or within 3.5 standard deviations where that is more: no fused
surface is to be trusted to less than a voxel everywhere."""
SETTLED_FLOORS, _SURE_FLOORS, _ENOUGH_FLOORS = 0.3, 0.3, 0.05
"""Of that deviation, the length of a step after which a pose has settled; up to which a step is taken though the cost
rises, which is no smoother between the field's cells; and of one that is the last, since what is left is less still."""
_EDGE_SHARE, _CUT_FROM = 0.02, 0.01
"""Of the image's size, how wide its edge is, and of the points, how many there are too many for an object in sight."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DepthProblem:
    """A query against a model; lengths are metres. ``pivot_world`` (3,) is what poses are turned about."""

    model: PoseModel
    camera: PinholeCamera
    cloud: QueryCloud
    view: QueryView
    floor: float
    pivot_world: NDArray[np.float64]
    radius: float
    _kept: dict[tuple[int, int], DepthDescent] = field(default_factory=dict, init=False)

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
        """Move poses (n, 4, 4) downhill by the cloud's first ``count`` points and robust kernels (n,) of ``scales``."""
        return self._descents(len(poses), count).descend(poses, kind=kind, scales=scales, iterations=iterations)

    def _descents(self, poses: int, count: int) -> DepthDescent:
        """Return the arrays for so many poses and points, which are used again."""
        count = min(count, self.cloud.count)
        if (poses, count) not in self._kept:
            self._kept[poses, count] = DepthDescent(
                self.model,
                self.cloud,
                poses=poses,
                count=count,
                pivot_world=self.pivot_world,
                radius_m=self.radius,
                floor=self.floor,
                enough_m=_ENOUGH_FLOORS * self.floor,
                sure_m=_SURE_FLOORS * self.floor,
            )
        return self._kept[poses, count]

    def spread(self, poses: NDArray[np.float64], *, count: int) -> NDArray[np.float64]:
        """Return the robust standard deviation (n,) of the residuals that are there, at least the model's own."""
        residuals = np.sort(
            np.abs(
                point_residuals(
                    self.model,
                    self.cloud,
                    poses,
                    count=min(count, self.cloud.count),
                    floor=self.floor,
                    inlier_within=self.inlier_within,
                )
            )
        )
        # What has no field comes last, and the median is of what has.
        known = np.isfinite(residuals).sum(axis=1)
        each = np.arange(len(residuals))
        medians = (residuals[each, (known - 1) // 2] + residuals[each, known // 2]) / 2
        return np.maximum(1.4826 * np.where(known > 0, medians, self.radius), self.floor)

    def agreements(self, poses: NDArray[np.float64], *, within: float, most: int | None = None) -> NDArray[np.float64]:
        """Return the share (n,) of the model's surface, as far as it should be seen, that the query shows."""
        return agreement(overlap(self.model, self.view, poses, within=within, most=most))

    def scores(self, poses: NDArray[np.float64], *, count: int = MIDDLE_POINTS) -> NDArray[np.float64]:
        """Return how well poses (n, 4, 4) explain the view, from 0 to 1: the geometric mean of both ways.

        Of the query ``count`` points are asked, and four times as many of the model, of which most are not in sight.
        """
        wide = Robustness(
            kind=GEMAN_MCCLURE,
            scales=np.full(len(poses), 4 * self.floor),
            floor=self.floor,
            inlier_within=self.inlier_within,
        )
        some = min(count, self.cloud.count)
        normals = normal_equations(
            self.model, self.cloud, poses, count=some, pivot_world=self.pivot_world, robustness=wide
        )
        agreed = self.agreements(poses, within=2 * self.tolerance, most=4 * count)
        return np.sqrt(np.maximum(1 - 2 * normals.cost, 0) * agreed)

    def distances(self, poses: NDArray[np.float64], other: Matrix) -> NDArray[np.float64]:
        """Return how far (n,), metres, points of what is seen are moved from where another pose has them, at most."""
        moved = poses @ inverse(other)
        shifts = np.linalg.norm(moved[:, :3, :3] @ self.pivot_world + moved[:, :3, 3] - self.pivot_world, axis=1)
        return shifts + self.radius * np.linalg.norm(log_so3(moved[:, :3, :3]), axis=1)

    def explained(self, found: Descent) -> float:
        """Return how much of the view a descent of one pose explains: of points and of the surface, the lesser share.

        The surface counts as far as it should be seen: what something hides is not expected.
        """
        agreed = self.agreements(found.poses, within=2 * self.tolerance)
        return float(min(found.normals.inliers[0], agreed[0]))

    @cached_property
    def is_cut(self) -> bool:
        """Whether the image's edge cuts off what the query shows, so that its middle is not that of an object."""
        camera, size = self.camera, np.array([self.camera.width, self.camera.height])
        pixels = camera.project(self.cloud.points_camera[:MIDDLE_POINTS])
        at_edge = (np.minimum(pixels, size - 1 - pixels) < _EDGE_SHARE * size).any(axis=1)
        return bool(at_edge.mean() > _CUT_FROM)


def model_noise(model: PoseModel) -> float:
    """Return the standard deviation of a model's own distances where it was seen well, metres."""
    return _MODEL_NOISE_VOXELS * model.voxel_size


def depth_problem(model: PoseModel, query: Query, cloud: QueryCloud, start: Matrix) -> DepthProblem:
    """Choose the pivot, in the middle of what is seen: turning and shifting about it are nearly independent there."""
    points = transform_points(start, cloud.points_camera[:MIDDLE_POINTS])
    pivot = np.median(points, axis=0)
    return DepthProblem(
        model=model,
        camera=query.camera,
        cloud=cloud,
        view=query_view(query, model=model),
        floor=model_noise(model),
        pivot_world=pivot,
        radius=max(float(np.sqrt(((points - pivot) ** 2).sum(axis=1).mean())), 4 * model.voxel_size),
    )
