"""Where to look closely: the place where two meshes of one surface differ most in how far they are from the truth."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import transform_points
from fusion.report.subject import Subject
from fusion.surface.closest_points import closest_points
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

PIXELS_PER_VOXEL = 14
"""So large that single triangles are seen."""


@dataclass(frozen=True, kw_only=True)
class CloseUp:
    """A camera at the subject's view that shows a part of it, and how wide that part is, metres."""

    camera: PinholeCamera
    width: float


def close_up(subject: Subject, one: Mesh, other: Mesh) -> CloseUp:
    """Return a view so close that voxels are seen, of where two meshes' errors, up to half a voxel, differ most."""
    first_errors, depth = _errors_seen(subject, one)
    second_errors, _ = _errors_seen(subject, other)
    camera = subject.view.camera
    distance = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
    closer = max(PIXELS_PER_VOXEL * distance / (camera.fx * subject.voxel_size), 1.0)
    width, height = max(round(camera.width / closer), 1), max(round(camera.height / closer), 1)
    u, v = _centre_of_most(np.abs(first_errors - second_errors), width, height)
    here = float(depth[v, u]) or distance
    part = replace(
        camera,
        fx=closer * camera.fx,
        fy=closer * camera.fy,
        cx=closer * (camera.cx - u) + (camera.width - 1) / 2,
        cy=closer * (camera.cy - v) + (camera.height - 1) / 2,
    )
    return CloseUp(camera=part, width=camera.width * here / part.fx)


def _centre_of_most(values: NDArray[np.float64], width: int, height: int) -> tuple[int, int]:
    """Return (u, v), the centre of the window of so many pixels, within the image, that has the largest sum."""
    rows, columns = values.shape
    left, top = width // 2, height // 2
    sums = cv2.boxFilter(values, -1, (width, height))
    inside = sums[top : max(rows - (height - top), top) + 1, left : max(columns - (width - left), left) + 1]
    v, u = divmod(int(np.argmax(inside)), inside.shape[1])
    return u + left, v + top


def _errors_seen(subject: Subject, mesh: Mesh) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return for each pixel (height, width) how far what it sees is from the truth, up to half a voxel, and depth."""
    assert subject.truth is not None
    pose, camera = subject.view.world_from_camera, subject.view.camera
    depth = cast_rays_at_mesh(mesh, camera, [pose], device=subject.device, depth_only=True).depth.numpy()[0]
    seen = np.zeros(depth.shape)
    hit = depth > 0
    points = transform_points(pose, camera.back_project(depth)[hit])
    if len(points):
        distances = closest_points(subject.truth.mesh, points, device=subject.device).distances
        seen[hit] = np.minimum(distances, subject.voxel_size / 2)
    return seen, depth
