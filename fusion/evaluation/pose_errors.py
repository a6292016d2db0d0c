"""Errors of an object's pose, as the field defines them.

Poses are camera_from_model, 4×4 rigid; lengths metres, angles degrees, the image's errors pixels. Unless said
otherwise the definitions are those collected in T. Hodaň, J. Matas, Š. Obdržálek, "On Evaluation of 6D Object Pose
Estimation" (ECCVW 2016) and T. Hodaň et al., "BOP Challenge 2020 on 6D Object Localization" (ECCVW 2020).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree
from scipy.spatial.distance import pdist

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import Matrix, inverse, rotation_angle_deg, transform_points

VSD_DELTA = 0.015
"""Metres by which the model may lie behind the measured surface and still be seen (BOP's)."""
VSD_TAUS = tuple(np.round(np.arange(1, 11) * 0.05, 2).tolist())
"""Shares of the diameter by which distances may differ (BOP's)."""
BOP_SHARES = VSD_TAUS
"""Shares of the diameter over which BOP averages the recall of MSSD."""
BOP_PIXELS = tuple(range(5, 55, 5))
"""Pixels, in an image 640 wide, over which BOP averages the recall of MSPD."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelPoints:
    """Points (n, 3) of a model's surface, and the ``symmetries`` (k, 4, 4) of the model, the identity among them.

    Raises InputError for points that span no volume to measure.
    """

    points: NDArray[np.float64]
    symmetries: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Refuse what is not a set of points with symmetries."""
        if self.points.ndim != 2 or self.points.shape[1] != 3 or len(self.points) < 4:
            raise InputError(f"model points: found shape {self.points.shape}, expected at least four rows x y z")
        if not np.isfinite(self.points).all():
            raise InputError("model points: a coordinate is NaN or infinite; repair the model")

    @cached_property
    def tree(self) -> cKDTree:
        """The points, to find the nearest one."""
        return cKDTree(self.points)

    @cached_property
    def hull(self) -> NDArray[np.float64]:
        """The points (m, 3) that are corners of the convex hull; all of them where they lie in a plane."""
        try:
            return self.points[ConvexHull(self.points).vertices]
        except QhullError:
            return self.points

    @cached_property
    def diameter(self) -> float:
        """The greatest distance between two points, metres; corners of the hull have it."""
        return float(pdist(self.hull).max())


def rotation_error_deg(estimate: Matrix, truth: Matrix) -> float:
    """Return the angle of the rotation that is left between two poses, degrees."""
    return rotation_angle_deg(inverse(estimate) @ truth)


def translation_error(estimate: Matrix, truth: Matrix, *, point_model: ArrayLike = (0.0, 0.0, 0.0)) -> float:
    """Return how far a point of the model, its origin if not given, is off in the camera's frame, metres."""
    point = np.asarray(point_model, dtype=np.float64)
    return float(np.linalg.norm(transform_points(estimate, point) - transform_points(truth, point)))


def average_distance(estimate: Matrix, truth: Matrix, model: ModelPoints) -> float:
    """Return ADD, the mean distance between a point as estimated and the same point in truth, metres.

    S. Hinterstoisser et al., "Model Based Training, Detection and Pose Estimation of Texture-Less 3D Objects in
    Heavily Cluttered Scenes" (ACCV 2012).
    """
    apart = transform_points(estimate, model.points) - transform_points(truth, model.points)
    return float(np.linalg.norm(apart, axis=1).mean())


def average_nearest_distance(estimate: Matrix, truth: Matrix, model: ModelPoints) -> float:
    """Return ADD-S (also ADI), the mean distance from a point in truth to the nearest one as estimated, metres.

    Hinterstoisser et al. (ACCV 2012), for objects that look alike from several sides. Rigid motions keep distances:
    the truth is taken into the estimate's frame, so that one tree serves all poses.
    """
    distances, _ = model.tree.query(transform_points(inverse(estimate) @ truth, model.points))
    return float(distances.mean())


def projection_error_px(estimate: Matrix, truth: Matrix, model: ModelPoints, camera: PinholeCamera) -> float:
    """Return the mean distance in the image between a point as estimated and in truth, pixels.

    E. Brachmann et al., "Uncertainty-Driven 6D Pose Estimation of Objects and Scenes from a Single RGB Image" (CVPR
    2016), who count up to 5 pixels as right. Infinite where a point lies behind the camera.
    """
    found, there = transform_points(estimate, model.points), transform_points(truth, model.points)
    return float(_pixels_apart(camera, found, there).mean())


def mssd(estimate: Matrix, truth: Matrix, model: ModelPoints) -> float:
    """Return the maximum symmetry-aware surface distance, metres (BOP 2020).

    That is the greatest distance of a point as estimated from where it is in truth, for the symmetry that makes it
    least. The distance is a convex function of the point, so that a corner of the convex hull has the greatest.
    """
    found = transform_points(estimate, model.hull)
    return min(
        float(np.linalg.norm(found - transform_points(truth @ symmetry, model.hull), axis=1).max())
        for symmetry in model.symmetries
    )


def mspd(estimate: Matrix, truth: Matrix, model: ModelPoints, camera: PinholeCamera) -> float:
    """Return the maximum symmetry-aware projection distance, pixels (BOP 2020).

    As ``mssd``, in the image. Infinite where a point lies behind the camera.
    """
    found = transform_points(estimate, model.points)
    return min(
        float(_pixels_apart(camera, found, transform_points(truth @ symmetry, model.points)).max())
        for symmetry in model.symmetries
    )


def _pixels_apart(camera: PinholeCamera, some: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far points (n, 3), camera frame, are from others in the image (n,); infinite for one behind it."""
    before = (some[:, 2] > 0) & (others[:, 2] > 0)
    apart = camera.project(some[before]) - camera.project(others[before])
    result = np.full(len(some), np.inf)
    result[before] = np.linalg.norm(apart, axis=1)
    return result


def visible_surface_discrepancy(
    depth_estimate: NDArray[np.floating],
    depth_truth: NDArray[np.floating],
    depth_measured: NDArray[np.floating],
    camera: PinholeCamera,
    *,
    diameter: float,
    delta: float = VSD_DELTA,
    taus: Sequence[float] = VSD_TAUS,
) -> tuple[float, ...]:
    """Return VSD, the share of what is visible of the model in either pose that does not agree, one for each τ.

    The three depth images (height, width) are planar, metres, 0 = invalid: of the model alone in the estimated and in
    the true pose, and as measured. Distances are along rays. The model is visible where it is no farther than
    ``delta`` behind what was measured, or nothing was; in the estimated pose also where it is so in truth. Both
    visible, they agree where the distances differ by less than τ diameters (Hodaň et al., ECCVW 2020, equation 1; the
    visibility of Hodaň, Matas, Obdržálek 2016, equations 13 and 14, with BOP 2019's rule for missing depth). 1 where
    it is visible in neither.
    """
    stretch = np.linalg.norm(camera.back_project(np.ones((camera.height, camera.width))), axis=-1)
    estimate, truth, measured = (
        np.asarray(depth, dtype=np.float64) * stretch for depth in (depth_estimate, depth_truth, depth_measured)
    )
    free = measured == 0
    visible_truth = (truth > 0) & (free | (truth - measured <= delta))
    visible_estimate = (estimate > 0) & (free | (estimate - measured <= delta) | visible_truth)
    either = int((visible_truth | visible_estimate).sum())
    both = visible_truth & visible_estimate
    if either == 0:
        return tuple(1.0 for _ in taus)
    apart = np.abs(truth[both] - estimate[both]) / diameter
    alone = either - int(both.sum())
    return tuple((int((apart >= tau).sum()) + alone) / either for tau in taus)


def recall(errors: ArrayLike, *, below: float) -> float:
    """Return the share of ``errors`` that are less than ``below``; an error that is NaN is a failure.

    Raises InputError where there are none.
    """
    values = np.asarray(errors, dtype=np.float64)
    if values.size == 0:
        raise InputError("recall: there are no errors to count")
    return float((values < below).mean())


def within(rotations_deg: ArrayLike, translations: ArrayLike, *, degrees: float, metres: float) -> float:
    """Return the share of poses with both errors less than the bounds: "n cm n°".

    J. Shotton et al., "Scene Coordinate Regression Forests for Camera Relocalization in RGB-D Images" (CVPR 2013), for
    5 cm 5°.
    """
    turned = np.asarray(rotations_deg, dtype=np.float64) < degrees
    moved = np.asarray(translations, dtype=np.float64) < metres
    return recall(np.where(turned & moved, 0.0, 1.0), below=0.5)


def average_recall(errors: ArrayLike, thresholds: Sequence[float]) -> float:
    """Return BOP's average recall: the mean, over ``thresholds``, of the share of errors below each."""
    return float(np.mean([recall(errors, below=threshold) for threshold in thresholds]))
