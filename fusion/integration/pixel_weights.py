"""The weight w_new of every pixel, where it is not simply 1."""

from functools import cache
from typing import Any

import warp as wp

from fusion.devices import Kernel, launch_in_slabs
from fusion.frames.frame_batch import FrameBatch
from fusion.integration.options import Weighting

LEAST_COSINE = 0.05
"""A surface seen edge-on keeps this weight, so that what only grazing views saw is there at all."""

_CODES: dict[Weighting, int] = {"constant": 0, "inverse-square": 1, "cosine": 2}
_INVERSE_SQUARE = wp.constant(_CODES["inverse-square"])
_COSINE = wp.constant(_CODES["cosine"])
_LEAST_COSINE = wp.constant(LEAST_COSINE)


@wp.func
def ray_through(u: float, v: float, intrinsics: wp.vec4) -> wp.vec3:
    """Return the ray through a pixel, in the camera's frame, up to z = 1; ``intrinsics`` are fx, fy, cx, cy."""
    return wp.vec3((u - intrinsics[2]) / intrinsics[0], (v - intrinsics[3]) / intrinsics[1], 1.0)


@wp.func
def tangent(before: float, here: wp.vec3, after: float, ray_before: wp.vec3, ray_after: wp.vec3) -> wp.vec3:
    """Return the difference between the points before and after, or between one of them and the point itself.

    ``before`` and ``after`` are depths, metres, 0 where there is none; ``here`` is the point, camera frame.
    """
    start = here
    end = here
    if before > 0.0:
        start = before * ray_before
    if after > 0.0:
        end = after * ray_after
    return end - start


@wp.func
def neighbour(depth: wp.array3d(dtype=Any), frame: int, v: int, u: int, scale: float, z: float, step: float) -> float:
    """Return the depth of a neighbouring pixel, 0 where it is none, or of another surface."""
    if v < 0 or u < 0 or v >= depth.shape[1] or u >= depth.shape[2]:
        return 0.0
    other = scale * float(depth[frame, v, u])
    if wp.abs(other - z) <= step:
        return other
    return 0.0


@wp.func
def cosine_seen(
    depth: wp.array3d(dtype=Any),
    frame: int,
    v: int,
    u: int,
    scale: float,
    z: float,
    intrinsics: wp.vec4,
    step: float,
) -> float:
    """Return the cosine of the angle between a pixel's ray and the surface's normal there."""
    x = float(u)
    y = float(v)
    here = z * ray_through(x, y, intrinsics)
    along_u = tangent(
        neighbour(depth, frame, v, u - 1, scale, z, step),
        here,
        neighbour(depth, frame, v, u + 1, scale, z, step),
        ray_through(x - 1.0, y, intrinsics),
        ray_through(x + 1.0, y, intrinsics),
    )
    along_v = tangent(
        neighbour(depth, frame, v - 1, u, scale, z, step),
        here,
        neighbour(depth, frame, v + 1, u, scale, z, step),
        ray_through(x, y - 1.0, intrinsics),
        ray_through(x, y + 1.0, intrinsics),
    )
    normal = wp.cross(along_u, along_v)
    return wp.abs(wp.dot(normal, here)) / wp.max(wp.length(normal) * wp.length(here), 1.0e-20)


@cache
def kernel(depth_type: type) -> Kernel:
    """Return the kernel for depth of a type, uint16 or float32; its threads take a pixel each."""

    @wp.kernel(module="unique", enable_backward=False)
    def weigh_pixels(
        first: int,
        depth: wp.array3d(dtype=depth_type),
        scale: float,
        intrinsics: wp.vec4,  # fx, fy, cx, cy
        step: float,
        weighting: int,
        weights: wp.array3d(dtype=float),
    ) -> None:
        index = wp.tid() + first
        u = index % depth.shape[2]
        v = (index / depth.shape[2]) % depth.shape[1]
        frame = index / (depth.shape[2] * depth.shape[1])
        z = scale * float(depth[frame, v, u])
        weight = float(0.0)
        if z > 0.0:
            if weighting == _INVERSE_SQUARE:
                weight = 1.0 / (z * z)
            if weighting == _COSINE:
                weight = wp.max(cosine_seen(depth, frame, v, u, scale, z, intrinsics, step), _LEAST_COSINE)
        weights[frame, v, u] = weights[frame, v, u] * weight

    return weigh_pixels


def pixel_weights(batch: FrameBatch, weighting: Weighting, *, step: float) -> wp.array | None:
    """Return the weights (frames, height, width) of a batch's pixels, None where all are 1.

    ``weighting`` is as in ``Integration``; the batch's own ``pixel_weights`` multiply it. Normals are taken between
    pixels whose depths differ by at most ``step`` metres.
    """
    if weighting == "constant":
        return batch.pixel_weights
    camera, device = batch.camera, batch.depth.device
    weights = wp.full(batch.depth.shape, 1.0, dtype=float, device=device)
    if batch.pixel_weights is not None:
        wp.copy(weights, batch.pixel_weights)
    launch_in_slabs(
        kernel(batch.depth.dtype),
        dim=weights.size,
        inputs=[
            batch.depth,
            batch.depth_scale,
            wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy),
            step,
            _CODES[weighting],
        ],
        outputs=[weights],
        device=device,
    )
    return weights
