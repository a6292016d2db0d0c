"""Ray casting of a mesh at pixel centres in double precision: the truth that rendered images are held against.

Each triangle is intersected with the rays of the pixels in its bounding box, by solving its plane; there is no search
structure and nothing in common with Blender or Embree.
"""

from dataclasses import dataclass

import numpy as np

from datagen.rigid import inverse, transform_points


@dataclass(frozen=True, kw_only=True)
class Cast:
    """``depth`` (H, W) planar, inf where nothing is hit; ``triangle`` (H, W) its index, −1 for none.

    ``normals`` (H, W, 3) unit, camera axes, towards the camera, 0 where nothing is hit.
    """

    depth: np.ndarray
    triangle: np.ndarray
    normals: np.ndarray


def cast(vertices_world, triangles, camera, world_from_camera):
    """Cast the rays of all pixels' centres on a mesh."""
    vertices = transform_points(inverse(world_from_camera), np.asarray(vertices_world, np.float64))
    corners = vertices[np.asarray(triangles)]
    last = np.array([camera.width - 1, camera.height - 1])
    behind = (corners[:, :, 2] < 1e-6).any(axis=1)  # in part or all: such a triangle may appear anywhere
    pixels = camera.project(np.where(behind[:, None, None], [0, 0, 1], corners))
    low = np.clip(np.ceil(pixels.min(axis=1)), 0, last + 1).astype(int)
    high = np.clip(np.floor(pixels.max(axis=1)), -1, last).astype(int)
    low[behind], high[behind] = 0, last
    high[(corners[:, :, 2] < 1e-6).all(axis=1)] = -1
    depth = np.full((camera.height, camera.width), np.inf)
    hit = np.full(depth.shape, -1)
    # Homogeneous edge functions: a ray d is inside if all d · (a × b) have one sign.
    edges = np.stack([np.cross(corners[:, i], corners[:, (i + 1) % 3]) for i in range(3)], axis=1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    offset = np.einsum("ij,ij->i", normal, corners[:, 0])
    for number in np.flatnonzero((low <= high).all(axis=1)):
        (u0, v0), (u1, v1) = low[number], high[number]
        u, v = np.meshgrid(np.arange(u0, u1 + 1), np.arange(v0, v1 + 1))
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
        sides = rays @ edges[number].T
        inside = (sides >= 0).all(axis=-1) | (sides <= 0).all(axis=-1)
        slope = rays @ normal[number]
        z = np.divide(offset[number], slope, out=np.full(slope.shape, np.inf), where=slope != 0)
        block = (slice(v0, v1 + 1), slice(u0, u1 + 1))
        nearer = inside & (z > 0) & (z < depth[block])
        depth[block][nearer] = z[nearer]
        hit[block][nearer] = number
    normals = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-300)
    facing = np.where((offset < 0)[:, None], normals, -normals)
    return Cast(
        depth=depth,
        triangle=hit,
        normals=np.where((hit >= 0)[..., None], facing[hit], 0),
    )
