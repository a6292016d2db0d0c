"""The nearest already-fused pose: least mean squared error over TSDF surface points, geometry only (section IV-C).

The volume's surface is seen from every fused pose, as the small depth image that rays through pixel centres give. A
query from one of those poses would show the same surface at the same pixels; so each candidate is scored by the mean
squared difference in depth, over all pixels where the query or the model has a surface. Texture plays no part.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import Matrix
from fusion.devices import Device, launch_in_slabs
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

VIEW_WIDTH = 80
"""About how many pixels wide the compared images are."""

LARGEST_DIFFERENCE = 0.1
"""Depths differ by at most this share of the query's median depth; more, or no surface at all, counts as much."""


@dataclass(frozen=True, kw_only=True)
class SurfaceViews:
    """The model's surface from each candidate pose.

    ``depth`` (candidates, height, width) planar metres, 0 where there is no surface, on a device; ``step`` is
    the query's pixels to one of these.
    """

    depth: wp.array
    step: int


@dataclass(frozen=True, kw_only=True)
class NearestPose:
    """The best of the candidates: its ``index``, and ``scores`` (candidates,) of all, in m²; less is nearer."""

    index: int
    scores: NDArray[np.float64]


@wp.kernel
def _score_views(
    first: int,
    query: wp.array2d(dtype=float),
    views: wp.array3d(dtype=float),
    largest_difference: float,
    scores: wp.array(dtype=float),
) -> None:
    candidate = wp.tid() + first
    total = float(0.0)
    pixels = float(0.0)
    for v in range(query.shape[0]):
        for u in range(query.shape[1]):
            ours = query[v, u]
            theirs = views[candidate, v, u]
            if ours > 0.0 or theirs > 0.0:
                difference = largest_difference
                if ours > 0.0 and theirs > 0.0:
                    difference = wp.min(wp.abs(ours - theirs), largest_difference)
                total += difference * difference
                pixels += 1.0
    scores[candidate] = total / pixels


def view_surface(surface: Mesh, candidates: list[Matrix], camera: PinholeCamera, *, device: Device) -> SurfaceViews:
    """See the volume's surface, a mesh in the world frame, from candidate poses (world_from_camera).

    ``camera`` is the queries' camera.
    """
    step = max(camera.width // VIEW_WIDTH, 1)
    small = camera.subsampled(step)
    hits = cast_rays_at_mesh(surface, small, candidates, device=device, depth_only=True)
    return SurfaceViews(depth=hits.depth, step=step)


def find_nearest_pose(views: SurfaceViews, depth: NDArray[np.float32]) -> NearestPose:
    """Score every candidate for a query's planar depth (height, width), metres, 0 = invalid.

    Raises InputError where the query has no valid depth.
    """
    query = np.ascontiguousarray(depth[:: views.step, :: views.step])
    if not (query > 0).any():
        raise InputError("no pixel has a valid depth, so there is no surface to compare")
    device = views.depth.device
    scores = wp.empty(views.depth.shape[0], dtype=float, device=device)
    launch_in_slabs(
        _score_views,
        dim=views.depth.shape[0],
        inputs=[
            wp.array(query, dtype=float, device=device),
            views.depth,
            LARGEST_DIFFERENCE * float(np.median(query[query > 0])),
        ],
        outputs=[scores],
        device=device,
    )
    found = scores.numpy().astype(np.float64)
    return NearestPose(index=int(found.argmin()), scores=found)
