"""Rays against a triangle mesh, through a bounding volume hierarchy."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import warp as wp

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix
from fusion.devices import Device, launch_in_slabs
from fusion.surface.mesh import Mesh

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

Hierarchy: TypeAlias = Any
"""Warp's mesh with its tree of boxes; the type checker passes Warp over."""


@dataclass(frozen=True, kw_only=True)
class MeshHits:
    """What rays through pixel centres hit, one image for each pose, on a device.

    ``depth`` (n, height, width) planar metres, 0 where nothing is hit; ``triangles`` (n, height, width) the triangle's
    index, −1 where there is none; ``barycentric`` (n, height, width) of its first two corners.
    """

    depth: wp.array
    triangles: wp.array
    barycentric: wp.array


@wp.kernel
def _cast_rays(
    first: int,
    mesh: wp.uint64,
    world_from_camera: wp.array(dtype=wp.mat44),
    intrinsics: wp.vec4,  # fx, fy, cx, cy
    depth: wp.array3d(dtype=float),
    triangles: wp.array3d(dtype=int),
    barycentric: wp.array3d(dtype=wp.vec2),
) -> None:
    index = wp.tid() + first
    width = depth.shape[2]
    height = depth.shape[1]
    u = index % width
    v = (index / width) % height
    view = index / (width * height)
    # With z = 1 the length along the ray, in units of its own, is planar depth.
    ray = wp.vec3((float(u) - intrinsics[2]) / intrinsics[0], (float(v) - intrinsics[3]) / intrinsics[1], 1.0)
    pose = world_from_camera[view]
    origin = wp.transform_point(pose, wp.vec3(0.0, 0.0, 0.0))
    direction = wp.transform_vector(pose, ray)
    length = wp.length(direction)
    hit = wp.mesh_query_ray(mesh, origin, direction / length, 1.0e6)
    depth[view, v, u] = wp.where(hit.result, hit.t / length, 0.0)
    if triangles.shape[0] > 0:
        triangles[view, v, u] = wp.where(hit.result, hit.face, -1)
        barycentric[view, v, u] = wp.vec2(hit.u, hit.v)


def mesh_hierarchy(mesh: Mesh, *, device: Device) -> Hierarchy:
    """Return a mesh's bounding volume hierarchy on a device, for whoever casts rays at it more than once."""
    return wp.Mesh(
        points=wp.array(mesh.vertices, dtype=wp.vec3, device=device),
        indices=wp.array(mesh.triangles.ravel(), dtype=int, device=device),
    )


def cast_rays_at_mesh(
    mesh: Mesh,
    camera: PinholeCamera,
    poses: Sequence[Matrix],
    *,
    device: Device,
    depth_only: bool = False,
    hierarchy: Hierarchy | None = None,
) -> MeshHits:
    """Cast a ray through each pixel centre of ``camera`` from each of ``poses`` (world_from_camera).

    With ``depth_only``, the other two arrays are empty. ``hierarchy`` is the mesh's, if it is there already.
    """
    shape = (len(poses), camera.height, camera.width)
    depth = wp.empty(shape, dtype=float, device=device)
    rest = (0, 0, 0) if depth_only else shape
    triangles = wp.empty(rest, dtype=int, device=device)
    barycentric = wp.empty(rest, dtype=wp.vec2, device=device)
    hierarchy = hierarchy or mesh_hierarchy(mesh, device=device)
    launch_in_slabs(
        _cast_rays,
        dim=depth.size,
        inputs=[
            hierarchy.id,
            wp.array(np.stack(poses).astype(np.float32), dtype=wp.mat44, device=device),
            wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy),
        ],
        outputs=[depth, triangles, barycentric],
        device=device,
    )
    return MeshHits(depth=depth, triangles=triangles, barycentric=barycentric)
