"""The part of a query's image in which its object or the model is, thinned out, and how exact its depth is there."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix, inverse, transform_points
from fusion.pose.pose_model import PoseModel
from fusion.pose.query import Query, depth_noise

TOLERANCE_SIGMAS = 3.5
TOLERANCE_SHARE = 0.015
"""Of the model's diameter, and of the depth, up to which depths always agree: real sensors are off by more than their
noise tells."""
_MODEL_NOISE_VOXELS, _TOLERANCE_VOXELS = 0.12, 1.0
_MARGIN_PX = 4


@dataclass(frozen=True, kw_only=True)
class ObjectWindow:
    """``rows`` and ``columns`` of the image, every ``step``-th of them, and the ``camera`` that sees just these."""

    rows: slice
    columns: slice
    step: int
    camera: PinholeCamera

    def of(self, image: NDArray) -> NDArray:
        """Return the window of an image (height, width, …)."""
        return image[self.rows, self.columns]


def object_window(model: PoseModel, query: Query, world_from_camera: Matrix, *, most: int) -> ObjectWindow | None:
    """Return the window about the query's mask, or all of its depth, and the model seen from a pose.

    It has about ``most`` pixels. None where there is nothing: no depth and no mask, or empty ones, and no model.
    """
    camera = query.camera
    here = query.mask if query.mask is not None else None if query.depth is None else query.whole_depth() > 0
    if here is None:
        return None
    some = model.mesh.vertices[:: max(len(model.mesh.vertices) // 2000, 1)]
    points = transform_points(inverse(world_from_camera), some)
    pixels = camera.project(points[points[:, 2] > 1e-3]).clip((0, 0), (camera.width - 1, camera.height - 1))
    v, u = np.nonzero(here)
    corners = np.concatenate([np.stack([u, v], axis=1), pixels])
    if not len(u):
        return None
    left, top = np.maximum(corners.min(axis=0).astype(int) - _MARGIN_PX, 0)
    right, bottom = np.minimum(corners.max(axis=0).astype(int) + _MARGIN_PX + 1, (camera.width, camera.height))
    step = max(int(np.ceil(np.sqrt((right - left) * (bottom - top) / most))), 1)
    cropped = PinholeCamera(
        width=-(-int(right - left) // step),
        height=-(-int(bottom - top) // step),
        fx=camera.fx / step,
        fy=camera.fy / step,
        cx=(camera.cx - left) / step,
        cy=(camera.cy - top) / step,
    )
    return ObjectWindow(rows=slice(top, bottom, step), columns=slice(left, right, step), step=step, camera=cropped)


def depth_tolerance(model: PoseModel, query: Query, depth: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return how far from the model's surface, metres, measured depths (height, width) may be and still agree.

    3.5 standard deviations of the query's noise and the model's, at least a voxel, and at least 1.5 % of the model's
    diameter or, for a room, of the depth.
    """
    sigma = np.hypot(depth_noise(query.valid_depth())(depth), _MODEL_NOISE_VOXELS * model.voxel_size)
    least = np.maximum(_TOLERANCE_VOXELS * model.voxel_size, TOLERANCE_SHARE * np.minimum(model.diameter, depth))
    return np.maximum(TOLERANCE_SIGMAS * sigma, least)
