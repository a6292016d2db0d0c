"""Optical flow of a static scene, from depth and two poses."""

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix, inverse, transform_points


def optical_flow(
    depth: NDArray[np.floating],
    camera: PinholeCamera,
    *,
    world_from_camera: Matrix,
    world_from_next: Matrix | None,
) -> NDArray[np.float32]:
    """Return how far (H, W, 2), pixels right and down, what each pixel shows moves until the next frame.

    ``depth`` (H, W) is planar metres, 0 = no surface. What something nearer hides in the next frame has its flow all
    the same. NaN where no surface is, where it lies behind the next camera, and everywhere if there is no next pose.
    """
    flow = np.full((*depth.shape, 2), np.nan, dtype=np.float32)
    seen = depth > 0
    if world_from_next is None:
        return flow
    points_next = transform_points(inverse(world_from_next) @ world_from_camera, camera.back_project(depth)[seen])
    before_camera = points_next[:, 2] > 0
    rows, columns = np.nonzero(seen)
    rows, columns, points_next = rows[before_camera], columns[before_camera], points_next[before_camera]
    flow[rows, columns] = camera.project(points_next) - np.stack([columns, rows], axis=-1)
    return flow
