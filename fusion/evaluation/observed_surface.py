"""Which points of the true surface did the frames see?"""

from collections.abc import Callable

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.dataset import Dataset
from datagen.progress import ProgressReporter, silent
from fusion.devices import Device, launch_in_slabs
from fusion.frames.frame_batch import FrameBatch, FrameUploader
from fusion.frames.frame_source import FrameSource

wp.set_module_options({"enable_backward": False})

PIXELS_OF_SLACK = 2.0
"""A point may lie this many pixel widths behind its pixel's depth: within a pixel a slanted surface recedes."""


@wp.kernel
def _mark_observed(
    first: int,
    points: wp.array(dtype=wp.vec3),
    depth: wp.array3d(dtype=wp.uint16),
    depth_scale: float,
    camera_from_world: wp.array(dtype=wp.mat44d),
    intrinsics: wp.vec4,  # fx, fy, cx, cy
    slack: float,
    observed: wp.array(dtype=wp.uint8),
) -> None:
    index = wp.tid() + first
    for frame in range(depth.shape[0]):
        point = wp.vec3(wp.transform_point(camera_from_world[frame], wp.vec3d(points[index])))
        if point[2] > 0.0:
            u = int(wp.floor(intrinsics[0] * point[0] / point[2] + intrinsics[2] + 0.5))
            v = int(wp.floor(intrinsics[1] * point[1] / point[2] + intrinsics[3] + 0.5))
            if u >= 0 and v >= 0 and u < depth.shape[2] and v < depth.shape[1]:
                seen = depth_scale * float(depth[frame, v, u])
                if seen > 0.0 and wp.abs(point[2] - seen) <= slack * point[2]:
                    observed[index] = wp.uint8(1)


def observed_points(
    points: NDArray[np.floating],
    dataset: Dataset,
    frame_ids: tuple[int, ...],
    *,
    device: Device,
    depth_max: float | None = None,
    progress: ProgressReporter = silent,
) -> NDArray[np.bool_]:
    """Tell which of ``points`` (n, 3), world frame, at least one of the frames saw: (n,) bool.

    What lies beyond ``depth_max`` metres of depth counts as unseen.
    """
    observed = wp.zeros(len(points), dtype=wp.uint8, device=device)
    on_device = wp.array(points.astype(np.float32), dtype=wp.vec3, device=device)
    advance: Callable[[], None] = progress("visibility", len(frame_ids))
    with FrameSource(dataset, frame_ids, depth_max=depth_max) as source:
        upload = FrameUploader(
            dataset.camera, device=device, capacity=source.batch_size, depth_scale=dataset.depth_scale
        )
        for frames in source.depth_batches():
            _mark(upload(frames.depths, frames.poses), on_device, observed, device)
            for _ in frames.frame_ids:
                advance()
    return observed.numpy() > 0


def _mark(batch: FrameBatch, points: wp.array, observed: wp.array, device: Device) -> None:
    camera = batch.camera
    launch_in_slabs(
        _mark_observed,
        dim=len(points),
        inputs=[
            points,
            batch.depth,
            batch.depth_scale,
            batch.camera_from_world,
            wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy),
            PIXELS_OF_SLACK / min(camera.fx, camera.fy),
        ],
        outputs=[observed],
        device=device,
    )
