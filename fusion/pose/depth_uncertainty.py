"""How well depth fixes a pose, with the errors that neighbouring pixels share."""

import numpy as np

from datagen.rigid import Matrix, transform_points
from fusion.pose.pose_model import PoseModel
from fusion.pose.query import Query, query_cloud
from fusion.pose.uncertainty import Uncertainty, clustered_uncertainty

_POINTS = 4000
_CLUSTERS_ACROSS = 6
"""Of the object's pixels: what a sensor's and a model's errors have in common reaches about that far."""
_TUKEY_SIGMAS = 4.685
_MODEL_NOISE_VOXELS = 0.12


def depth_uncertainty(model: PoseModel, query: Query, world_from_camera: Matrix) -> Uncertainty | None:
    """Return the uncertainty of a pose at which the query's points lie on the model; None where too few do."""
    cloud = query_cloud(query, device=model.device, most=_POINTS)
    if not cloud.count:
        return None
    points = transform_points(world_from_camera, cloud.points_camera)
    distances, normals, sources = model.sample(points)
    known = sources > 0
    if known.sum() < 6 * _CLUSTERS_ACROSS:
        return None
    floor = _MODEL_NOISE_VOXELS * model.voxel_size
    spread = max(1.4826 * float(np.median(np.abs(distances[known]))), floor)
    weights = np.where(known, np.clip(1 - (distances / (_TUKEY_SIGMAS * spread)) ** 2, 0, None) ** 2, 0.0)
    if not weights.sum() > 0:
        return None
    pivot = np.median(points, axis=0)
    radius = max(float(np.sqrt(((points - pivot) ** 2).sum(axis=1).mean())), 4 * model.voxel_size)
    pixels = query.camera.project(cloud.points_camera)
    side = max(float(np.sqrt(np.prod(np.ptp(pixels, axis=0) + 1))) / _CLUSTERS_ACROSS, 1.0)
    cells = np.floor((pixels - pixels.min(axis=0)) / side).astype(np.int64)
    normal = normals.astype(np.float64)
    return clustered_uncertainty(
        np.hstack([normal, np.cross(points - pivot, normal)]),
        distances.astype(np.float64),
        weights,
        cells @ np.array([1, 10_000]),
        pivot_world=pivot,
        radius_m=radius,
    )
