"""What the model looks like from every fused pose: small depth images, and patches that tell views apart."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix
from fusion.devices import Device
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

VIEW_WIDTH = 80
"""About how many pixels wide the images are."""

PATCH_SIDE = 24
DEPTH_EDGE = 0.03
"""Neighbouring pixels whose depths differ by more than this share of them are not of one surface."""

EMPTY = 1e6
"""Stands for "no surface" in a patch: as far from any surface as can be."""

RADIUS_PERCENTILE = 98


@dataclass(frozen=True, kw_only=True)
class ViewIndex:
    """The model seen from n poses by ``camera``, that of the queries with every ``step``-th pixel.

    ``world_from_camera`` (n, 4, 4); ``depth`` (n, height, width) float32 planar metres, 0 where there is no surface;
    ``normals`` (n, height, width, 3) unit vectors in the views' frames where ``oriented`` (n, height, width), which
    is not so at edges; ``patches`` (n, PATCH_SIDE²) as ``view_patch`` makes them, of ``radius`` metres; ``rays``
    (height, width, 3) have z = 1.
    """

    camera: PinholeCamera
    step: int
    world_from_camera: NDArray[np.float64]
    depth: NDArray[np.float32]
    normals: NDArray[np.float32]
    oriented: NDArray[np.bool_]
    patches: NDArray[np.float32]
    radius: float
    rays: NDArray[np.float64]

    def points(self, depth: NDArray[np.floating], *, step: int = 1) -> NDArray[np.float64]:
        """Return the points (m, 3), in its camera's frame, of every ``step``-th row and column of a small image."""
        return (self.rays[::step, ::step] * depth[..., None])[depth > 0]


def index_views(surface: Mesh, poses: Sequence[Matrix], camera: PinholeCamera, *, device: Device) -> ViewIndex:
    """See the volume's surface, a mesh in the world frame, from ``poses`` (world_from_camera).

    ``camera`` is the queries' camera. Views in which the model is not seen are kept, and are never similar to a query.
    """
    step = max(camera.width // VIEW_WIDTH, 1)
    small = camera.subsampled(step)
    depth = cast_rays_at_mesh(surface, small, poses, device=device, depth_only=True).depth.numpy()
    rays = small.back_project(np.ones((small.height, small.width)))
    clouds = [(rays * image[..., None])[image > 0] for image in depth]
    reaches = [
        np.percentile(np.linalg.norm(cloud - np.median(cloud, axis=0), axis=1), RADIUS_PERCENTILE)
        for cloud in clouds
        if len(cloud)
    ]
    radius = float(np.median(reaches)) if reaches else 1.0
    normals, oriented = _normals(depth, rays.astype(np.float32))
    return ViewIndex(
        camera=small,
        step=step,
        world_from_camera=np.stack(poses),
        depth=depth,
        normals=normals,
        oriented=oriented,
        patches=np.stack([view_patch(cloud, radius) for cloud in clouds]),
        radius=radius,
        rays=rays,
    )


def view_patch(points_camera: NDArray[np.float64], radius: float) -> NDArray[np.float32]:
    """Return how a visible surface looks along the line to its middle, whatever its place in the image.

    The points' median is moved to the origin and turned on to the optical axis; what lies within ``radius`` metres is
    seen by an orthographic camera of PATCH_SIDE² cells, nearest first: depths from the middle in radii (PATCH_SIDE²,),
    EMPTY where there is nothing.
    """
    patch = np.full(PATCH_SIDE**2, EMPTY, np.float32)
    if len(points_camera) == 0:
        return patch
    middle = np.median(points_camera, axis=0)
    local = (points_camera - middle) @ turn_between(middle, (0.0, 0.0, 1.0)).T / radius
    cells = np.floor((local[:, :2] + 1) / 2 * PATCH_SIDE).astype(int)
    inside = ((cells >= 0) & (cells < PATCH_SIDE)).all(axis=1)
    numbers = cells[inside] @ (1, PATCH_SIDE)
    np.minimum.at(patch, numbers, local[inside, 2].astype(np.float32))
    return patch


def _normals(depth: NDArray[np.float32], rays: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return normals (n, height, width, 3) by central differences, and where the neighbours are of one surface."""
    normals = np.zeros((*depth.shape, 3), np.float32)
    oriented = np.zeros(depth.shape, bool)
    for image, normal, known in zip(depth, normals, oriented, strict=True):
        points = rays * image[..., None]
        across = points[1:-1, 2:] - points[1:-1, :-2]
        down = points[2:, 1:-1] - points[:-2, 1:-1]
        product = cross(across, down)
        normal[1:-1, 1:-1] = product / np.maximum(np.linalg.norm(product, axis=-1, keepdims=True), 1e-30)
        step = 2 * DEPTH_EDGE * image[1:-1, 1:-1]
        known[1:-1, 1:-1] = (np.abs(across[..., 2]) < step) & (np.abs(down[..., 2]) < step)
        for rows, columns in (
            (slice(2, None), slice(1, -1)),
            (slice(-2), slice(1, -1)),
            (slice(1, -1), slice(2, None)),
        ):
            known[1:-1, 1:-1] &= image[rows, columns] > 0
        known[1:-1, 1:-1] &= image[1:-1, :-2] > 0
    return normals, oriented


def cross(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return a × b of vectors (…, 3); NumPy's own costs several times as much on small arrays."""
    result = np.empty(np.broadcast_shapes(a.shape, b.shape), np.result_type(a, b))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        result[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return result


def turn_between(start: ArrayLike, end: ArrayLike) -> NDArray[np.float64]:
    """Return the smallest rotation (3, 3) that turns the direction ``start`` into ``end``."""
    a, b = (np.asarray(way, dtype=np.float64) / np.linalg.norm(way) for way in (start, end))
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    if sine == 0:
        return np.eye(3) if a @ b > 0 else 2 * np.outer(_across(a), _across(a)) - np.eye(3)
    return np.asarray(cv2.Rodrigues(axis / sine * np.arctan2(sine, a @ b))[0], np.float64)


def _across(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return some unit vector across a direction."""
    other = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    return other / np.linalg.norm(other)
