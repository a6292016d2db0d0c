"""Which points of the true surface did the frames see?

A depth image knows a surface at its pixels' centres alone, and each centre speaks for the pixel's own square. A point p
of the truth is observed where it is in sight of a camera, nothing of the truth before it, and the camera measured, at
the centre of the square that p falls into, the surface that p lies on: where the plane that touches the truth at p
meets the pixel's ray at the depth D that the image has there,

    |n·p / n·r − D| ≤ z / 2f + s / 2,

with p = (x, y, z) and the normal n in the camera's frame, the pixel's ray r with z = 1, f pixels to z = 1, and steps s
of depth: half a pixel's width, less than which no pixel tells apart, and what storing rounds away.

So a slant is no matter as long as the surface is as good as flat within the pixel: a plane is observed edge-on too,
while one of radius R bends away from its plane by z²/8f²R cos³θ within half a pixel, at an angle θ between ray and
normal, and is observed up to cos³θ = z/4fR. What a camera could see in a slit that no pixel's ray enters is not.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.dataset import Dataset
from datagen.progress import ProgressReporter, silent
from fusion.devices import Device, Kernel, launch_in_slabs
from fusion.frames.frame_batch import FrameBatch, FrameUploader
from fusion.frames.frame_source import FrameSource
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import mesh_hierarchy

PIXELS_OF_SLACK = 0.5

CLEAR_SIGHT = 1.0 - 1e-4
"""Up to this share of the way to a point there must be nothing: the rest is the point's own surface, rounded."""


@cache
def kernel(depth_type: type) -> Kernel:
    """Return the kernel for depth of a type, uint16 or float32; its threads take a point each."""

    @wp.kernel(module="unique", enable_backward=False)
    def mark_observed(
        first: int,
        truth: wp.uint64,
        points: wp.array(dtype=wp.vec3),
        normals: wp.array(dtype=wp.vec3),
        depth: wp.array3d(dtype=depth_type),
        depth_scale: float,
        camera_from_world: wp.array(dtype=wp.mat44d),
        intrinsics: wp.vec4,  # fx, fy, cx, cy
        pixels_of_slack: float,
        rounding: float,
        clear_sight: float,
        observed: wp.array(dtype=wp.uint8),
    ) -> None:
        index = wp.tid() + first
        for frame in range(depth.shape[0]):
            if observed[index] == wp.uint8(0):
                point = wp.vec3(wp.transform_point(camera_from_world[frame], wp.vec3d(points[index])))
                if point[2] > 0.0:
                    u = int(wp.floor(intrinsics[0] * point[0] / point[2] + intrinsics[2] + 0.5))
                    v = int(wp.floor(intrinsics[1] * point[1] / point[2] + intrinsics[3] + 0.5))
                    if u >= 0 and v >= 0 and u < depth.shape[2] and v < depth.shape[1]:
                        seen = depth_scale * float(depth[frame, v, u])
                        normal = wp.vec3(wp.transform_vector(camera_from_world[frame], wp.vec3d(normals[index])))
                        ray = wp.vec3(
                            (float(u) - intrinsics[2]) / intrinsics[0], (float(v) - intrinsics[3]) / intrinsics[1], 1.0
                        )
                        # From the difference of the rays, which keeps the digits: n·p / n·r − z = n·(p − z r) / n·r.
                        off = wp.dot(normal, point - point[2] * ray) / wp.dot(normal, ray)
                        slack = pixels_of_slack * point[2] / wp.min(intrinsics[0], intrinsics[1]) + rounding
                        if seen > 0.0 and wp.abs(point[2] + off - seen) <= slack:
                            eye = wp.vec3(wp.transform_point(wp.inverse(camera_from_world[frame]), wp.vec3d()))
                            way = points[index] - eye
                            clear = wp.length(way)
                            hit = wp.mesh_query_ray(truth, eye, way / clear, clear * clear_sight)
                            if not hit.result:
                                observed[index] = wp.uint8(1)

    return mark_observed


def observed_points(
    points: NDArray[np.floating],
    normals: NDArray[np.floating],
    ground_truth: Mesh,
    dataset: Dataset,
    frame_ids: tuple[int, ...],
    *,
    device: Device,
    depth_max: float | None = None,
    progress: ProgressReporter = silent,
) -> NDArray[np.bool_]:
    """Tell which of ``points`` (n, 3) of ``ground_truth``, with ``normals`` (n, 3), the frames observed: (n,) bool.

    All are in the world frame; a normal may point to either side. What lies beyond ``depth_max`` metres of depth counts
    as unseen.
    """
    marks = PointMarks(points, normals, ground_truth, device=device)
    advance: Callable[[], None] = progress("visibility", len(frame_ids))
    with FrameSource(dataset, frame_ids, depth_max=depth_max) as source:
        upload = FrameUploader(
            dataset.camera, device=device, capacity=source.batch_size, depth_scale=dataset.depth_scale
        )
        for frames in source.depth_batches():
            marks.mark(upload(frames.depths, frames.poses))
            for _ in frames.frame_ids:
                advance()
    return marks.observed()


class PointMarks:
    """Points (n, 3) of a true surface with normals (n, 3), world frame, and whether a frame has observed them yet."""

    def __init__(
        self, points: NDArray[np.floating], normals: NDArray[np.floating], ground_truth: Mesh, *, device: Device
    ) -> None:
        self._points = wp.array(points.astype(np.float32), dtype=wp.vec3, device=device)
        self._normals = wp.array(normals.astype(np.float32), dtype=wp.vec3, device=device)
        self._truth = mesh_hierarchy(ground_truth, device=device)
        self._observed = wp.zeros(len(points), dtype=wp.uint8, device=device)

    def mark(self, batch: FrameBatch) -> None:
        """Mark what a batch of frames observes."""
        camera = batch.camera
        launch_in_slabs(
            kernel(batch.depth.dtype),
            dim=len(self._points),
            inputs=[
                self._truth.id,
                self._points,
                self._normals,
                batch.depth,
                batch.depth_scale,
                batch.camera_from_world,
                wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy),
                PIXELS_OF_SLACK,
                0.5 * batch.depth_scale if batch.depth.dtype is wp.uint16 else 0.0,
                CLEAR_SIGHT,
            ],
            outputs=[self._observed],
            device=self._observed.device,
        )

    def observed(self) -> NDArray[np.bool_]:
        """Tell which points were marked (n,)."""
        marked: NDArray[np.bool_] = self._observed.numpy() > 0
        return marked
