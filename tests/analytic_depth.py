"""Depth images whose every pixel is known in closed form."""

import numpy as np

from datagen.camera import PinholeCamera

CAMERA = PinholeCamera(width=320, height=240, fx=300.0, fy=310.0, cx=161.3, cy=117.8)


def rays(camera):
    """Return the rays (H, W, 3) with z = 1 through the pixel centres."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)


def tilted_plane(camera, *, distance, tilt_deg, axis=(0.0, 1.0)):
    """Return depth and incidence angle (H, W) of a plane that meets the optical axis at ``distance``.

    It is turned by ``tilt_deg`` about ``axis``, a direction in the image plane.
    """
    tilt, (ax, ay) = np.radians(tilt_deg), axis
    normal = np.array([np.sin(tilt) * ay, -np.sin(tilt) * ax, np.cos(tilt)])
    along = rays(camera) @ normal
    depth = np.where(along > 0, distance * normal[2] / along, 0)
    cosine = np.abs(along) / np.linalg.norm(rays(camera), axis=-1)
    return depth.astype(np.float32), np.arccos(np.minimum(cosine, 1))


def step(camera, *, near, far, column):
    """Return depth with ``near`` left of ``column`` and ``far`` from it on."""
    depth = np.full((camera.height, camera.width), far, np.float32)
    depth[:, :column] = near
    return depth
