"""What the model looks like from every fused pose: small depth images, and patches that tell views apart."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix
from fusion.devices import Device, launch_in_slabs
from fusion.pose.se3 import skew
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import Hierarchy, cast_rays_at_mesh, mesh_hierarchy

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

VIEW_WIDTH = 80
"""About how many pixels wide the images are."""

PATCH_SIDE = 24
_SIDE = wp.constant(PATCH_SIDE)

_EMPTY = wp.constant(1.0e6)
"""Stands for "no surface" in a patch: as far from any surface as can be."""

_PATCH_CAP = wp.constant(0.3)
"""In radii: patches differ by no more in a cell."""

RADIUS_PERCENTILE, _VIEWS_MEASURED = 98, 50
"""Of the points' distances from a view's middle; the radius is the median of about so many views'."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewIndex:
    """The model's ``surface`` seen from n poses by ``camera``, that of the queries with every ``step``-th pixel.

    ``world_from_camera`` (n, 4, 4); ``depth`` (n, height, width) float32 planar metres, 0 where there is no surface,
    and ``patches`` (n, PATCH_SIDE²) of ``radius`` metres, both on a device; ``middles`` (n, 3) the medians of what is
    seen, in the views' frames, 0 where that is nothing; ``rays`` (height, width, 3) have z = 1.

    A patch is how a visible surface looks along the line to its middle, whatever its place in the image: the middle is
    moved to the origin and turned on to the optical axis, and what lies within ``radius`` is seen by an orthographic
    camera, nearest first; depths are counted from the middle, in radii.
    """

    surface: Mesh
    hierarchy: Hierarchy
    camera: PinholeCamera
    step: int
    world_from_camera: NDArray[np.float64]
    depth: wp.array
    patches: wp.array
    middles: NDArray[np.float64]
    radius: float
    rays: NDArray[np.float64]

    @property
    def device(self) -> Device:
        """Where the images are."""
        return self.depth.device

    @property
    def intrinsics(self) -> wp.vec4:
        """Focal lengths and principal point of ``camera``, as kernels take them."""
        return wp.vec4(self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy)

    def points(self, depth: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the points (m, 3), in its camera's frame, of a small image."""
        return (self.rays * depth[..., None])[depth > 0]


def index_views(surface: Mesh, poses: Sequence[Matrix], camera: PinholeCamera, *, device: Device) -> ViewIndex:
    """See the volume's surface, a mesh in the world frame, from ``poses`` (world_from_camera).

    ``camera`` is the queries' camera. Views in which the model is not seen are kept, and are never similar to a query.
    """
    step = max(camera.width // VIEW_WIDTH, 1)
    small = camera.subsampled(step)
    hierarchy = mesh_hierarchy(surface, device=device)
    depth = cast_rays_at_mesh(surface, small, poses, device=device, depth_only=True, hierarchy=hierarchy).depth
    rays = small.back_project(np.ones((small.height, small.width)))
    middles = np.zeros((len(poses), 3))
    reaches = []
    for view, image in enumerate(depth.numpy()):
        seen = image > 0
        if seen.any():
            cloud = rays[seen] * image[seen][:, None]
            middles[view] = np.median(cloud, axis=0)
            if view % max(len(poses) // _VIEWS_MEASURED, 1) == 0:
                away = np.linalg.norm(cloud - middles[view], axis=1)
                reaches.append(np.percentile(away, RADIUS_PERCENTILE))
    index = ViewIndex(
        surface=surface,
        hierarchy=hierarchy,
        camera=small,
        step=step,
        world_from_camera=np.stack(poses),
        depth=depth,
        patches=wp.empty((0, 0), dtype=float, device=device),
        middles=middles,
        radius=float(np.median(reaches)) if reaches else 1.0,
        rays=rays,
    )
    return replace(index, patches=view_patches(index, depth, middles))


def seen_from(index: ViewIndex, poses: NDArray[np.float64]) -> ViewIndex:
    """Return the model seen from other ``poses`` (n, 4, 4), as an index without patches: to align with, not to search.

    A surface that is not seen there has a depth of 0, as in any index.
    """
    depth = cast_rays_at_mesh(
        index.surface, index.camera, list(poses), device=index.device, depth_only=True, hierarchy=index.hierarchy
    ).depth
    patches = wp.empty((0, 0), dtype=float, device=index.device)
    return replace(index, world_from_camera=poses, depth=depth, patches=patches, middles=np.zeros((len(poses), 3)))


@wp.kernel
def _see_patches(
    first: int,
    depth: wp.array3d(dtype=float),
    intrinsics: wp.vec4,
    middles: wp.array(dtype=wp.vec3),
    turns: wp.array(dtype=wp.mat33),
    radius: float,
    bands: int,
    patches: wp.array2d(dtype=float),
) -> None:
    index = wp.tid() + first
    view = index / bands
    band = index % bands
    for cell in range(_SIDE * _SIDE):
        patches[index, cell] = _EMPTY
    for v in range(band, depth.shape[1], bands):
        for u in range(depth.shape[2]):
            z = depth[view, v, u]
            if z > 0.0:
                x = (float(u) - intrinsics[2]) / intrinsics[0]
                y = (float(v) - intrinsics[3]) / intrinsics[1]
                local = turns[view] * (wp.vec3(x * z, y * z, z) - middles[view]) / radius
                column = int(wp.floor(0.5 * (local[0] + 1.0) * float(_SIDE)))
                row = int(wp.floor(0.5 * (local[1] + 1.0) * float(_SIDE)))
                if column >= 0 and row >= 0 and column < _SIDE and row < _SIDE:
                    cell = _SIDE * row + column
                    patches[index, cell] = wp.min(patches[index, cell], local[2])


@wp.kernel
def _merge_bands(first: int, bands: int, parts: wp.array2d(dtype=float), patches: wp.array2d(dtype=float)) -> None:
    index = wp.tid() + first
    view = index / parts.shape[1]
    cell = index % parts.shape[1]
    nearest = float(_EMPTY)
    for band in range(bands):
        nearest = wp.min(nearest, parts[view * bands + band, cell])
    patches[view, cell] = nearest


def view_patches(index: ViewIndex, depth: wp.array, middles: NDArray[np.float64], *, bands: int = 1) -> wp.array:
    """Return the patches (n, PATCH_SIDE²) of depth images (n, height, width) about their ``middles`` (n, 3).

    Rows are divided among ``bands`` threads: for few images on a device of many cores.
    """
    device = index.device
    seen = middles.any(axis=1, keepdims=True)
    turns = turn_between(np.where(seen, middles, (0, 0, 1)), (0, 0, 1))
    parts = wp.empty((len(middles) * bands, PATCH_SIDE**2), dtype=float, device=device)
    launch_in_slabs(
        _see_patches,
        dim=len(parts),
        inputs=[
            *(depth, index.intrinsics),
            wp.array(middles.astype(np.float32), dtype=wp.vec3, device=device),
            wp.array(turns.astype(np.float32), dtype=wp.mat33, device=device),
            *(index.radius, bands),
        ],
        outputs=[parts],
        device=device,
    )
    if bands == 1:
        return parts
    patches = wp.empty((len(middles), PATCH_SIDE**2), dtype=float, device=device)
    launch_in_slabs(_merge_bands, dim=patches.size, inputs=[bands, parts], outputs=[patches], device=device)
    return patches


@wp.kernel
def _differ(
    first: int, patches: wp.array2d(dtype=float), patch: wp.array2d(dtype=float), differences: wp.array(dtype=float)
) -> None:
    view = wp.tid() + first
    total = float(0.0)
    for cell in range(patches.shape[1]):
        apart = wp.min(wp.abs(patches[view, cell] - patch[0, cell]), _PATCH_CAP)
        total += apart * apart
    differences[view] = total


def patch_differences(index: ViewIndex, patch: wp.array) -> NDArray[np.float32]:
    """Return how far each view's patch is from ``patch`` (1, PATCH_SIDE²): capped squares, summed (n,)."""
    differences = wp.empty(len(index.patches), dtype=float, device=index.device)
    launch_in_slabs(
        _differ,
        dim=len(differences),
        inputs=[index.patches, patch],
        outputs=[differences],
        device=index.device,
        least_slab=64,
    )
    return differences.numpy()


def turn_between(start: ArrayLike, end: ArrayLike) -> NDArray[np.float64]:
    """Return the smallest rotations (…, 3, 3) that turn directions ``start`` (…, 3) into ``end`` (…, 3)."""
    a, b = (way / np.linalg.norm(way, axis=-1, keepdims=True) for way in np.broadcast_arrays(start, end))
    k = skew(np.cross(a, b))
    cosine = (a * b).sum(axis=-1)[..., None, None]
    opposite = cosine < -1 + 1e-12
    turns = np.eye(3) + k + k @ k / np.where(opposite, 1, 1 + cosine)
    if opposite.any():
        # By half a turn about any axis across them.
        axis = np.cross(a, np.eye(3)[np.abs(a).argmin(axis=-1)])
        axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
        turns = np.where(opposite, 2 * axis[..., :, None] * axis[..., None, :] - np.eye(3), turns)
    return turns
