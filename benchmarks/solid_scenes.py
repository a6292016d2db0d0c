"""Solids in closed form, seen by sphere tracing, and how far points are from their edges: for ``surfaces.py edges``."""

import numpy as np
import warp as wp
from analytic_oracle import SolidState, solid_value

from benchmarks import accuracy
from fusion.devices import launch_in_slabs

wp.set_module_options({"enable_backward": False})

NEAR, FAR = 0.5, 2.0
"""Voxels from an edge up to which a point is on it, and from which on the surface is smooth."""


@wp.kernel
def _trace_rays(
    first: int,
    solid: SolidState,
    pose: wp.mat44,
    intrinsics: wp.vec4,
    depth: wp.array2d(dtype=float),
):
    index = wp.tid() + first
    width = depth.shape[1]
    u = index % width
    v = index / width
    ray = wp.vec3((float(u) - intrinsics[2]) / intrinsics[0], (float(v) - intrinsics[3]) / intrinsics[1], 1.0)
    origin = wp.transform_point(pose, wp.vec3(0.0, 0.0, 0.0))
    direction = wp.transform_vector(pose, ray)
    length = wp.length(direction)
    z = float(0.0)
    found = float(0.0)
    for _step in range(200):
        if z < 3.0 and found == 0.0:
            distance = solid_value(solid, 0, origin + z * direction)
            if distance < 1.0e-6:
                found = z
            z += wp.max(distance, 5.0e-7) / length
    depth[v, u] = found


class SolidScene(accuracy.Scene):
    """A solid in closed form, seen by sphere tracing."""

    def __init__(self, name, solid, device, views=60):
        super().__init__(name, accuracy.poses_around(views, centre=(0, 0, 0), nearest=1.3, farthest=1.6), device)
        self.solid = solid

    def depth(self, frame):
        camera = accuracy.CAMERA
        depth = wp.empty((camera.height, camera.width), dtype=float, device=self.device)
        state = self.solid.oracle(1.0, self.device).state
        pose = wp.mat44(*self.poses[frame].astype(np.float32).ravel().tolist())
        intrinsics = wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy)
        launch_in_slabs(
            _trace_rays, dim=depth.size, inputs=[state, pose, intrinsics], outputs=[depth], device=self.device
        )
        return depth.numpy()


def crease_distance(solid, points, voxel_size):
    """Return how far points are from an edge of the solid, up to 2 voxels: where normals around differ by over 25°."""
    ways = np.concatenate(
        [np.eye(3), -np.eye(3), *[np.array([[a, b, 0], [0, a, b], [a, 0, b]]) for a in (-1, 1) for b in (-1, 1)]]
    )
    ways = ways / np.linalg.norm(ways, axis=1, keepdims=True)

    def normals(at):
        step = 1e-4 * voxel_size
        slopes = [(solid(at + step * axis) - solid(at - step * axis)) / (2 * step) for axis in np.eye(3)]
        return np.stack(slopes, -1)

    distance = np.full(len(points), FAR + 0.01)
    for reach in (FAR, NEAR):
        around = []
        for way in ways:
            at = points + reach * voxel_size * way
            slope = normals(at)
            # Onto the surface, once: near an edge that lands beside it, which is all that is asked.
            at = at - (solid(at) / np.maximum((slope**2).sum(-1), 1e-9))[:, None] * slope
            inside_reach = np.linalg.norm(at - points, axis=1) <= 1.05 * reach * voxel_size
            around.append(np.where(inside_reach[:, None], normals(at), np.nan))
        around = np.stack(around)
        own = normals(points)
        cosines = np.einsum("knj,nj->kn", around, own)
        sharp = np.nanmin(np.where(np.isnan(cosines), 1.0, cosines), axis=0) < np.cos(np.deg2rad(25))
        distance[sharp] = reach
    return distance


def box_crease_distance(solid, points, voxel_size):
    """Return how far points are from the edges of a box, in voxels."""
    q = np.abs((points - solid.centres[0]) @ solid.rotations[0])
    return np.linalg.norm(np.sort(np.abs(q - solid.halves[0]), axis=1)[:, :2], axis=1) / voxel_size
