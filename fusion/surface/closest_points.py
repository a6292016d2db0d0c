"""Distances from points to a triangle mesh, exact and on every device."""

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from fusion.devices import Device, launch_in_slabs
from fusion.surface.mesh import Mesh

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True, kw_only=True)
class ClosestPoints:
    """For n points: ``distances`` (n,) metres to the mesh, and the index ``triangles`` (n,) of the closest triangle."""

    distances: NDArray[np.float64]
    triangles: NDArray[np.int32]


@wp.kernel
def _closest(
    first: int,
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    reach: float,
    distances: wp.array(dtype=float),
    triangles: wp.array(dtype=int),
) -> None:
    index = wp.tid() + first
    point = points[index]
    query = wp.mesh_query_point_no_sign(mesh, point, reach)
    triangles[index] = query.face
    distances[index] = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - point)


def closest_points(mesh: Mesh, points: NDArray[np.floating], *, device: Device) -> ClosestPoints:
    """Find the closest point of ``mesh`` to each of ``points`` (n, 3), by a bounding volume hierarchy.

    Both are taken relative to the points' mean, so that float32 keeps its digits far from the world's origin.
    """
    centre = points.mean(axis=0)
    local_points = (points - centre).astype(np.float32)
    local_vertices = (mesh.vertices - centre).astype(np.float32)
    hierarchy = wp.Mesh(
        points=wp.array(local_vertices, dtype=wp.vec3, device=device),
        indices=wp.array(mesh.triangles.ravel(), dtype=int, device=device),
    )
    distances = wp.empty(len(points), dtype=float, device=device)
    triangles = wp.empty(len(points), dtype=int, device=device)
    everything = np.concatenate([local_points, local_vertices])
    launch_in_slabs(
        _closest,
        dim=len(points),
        inputs=[
            hierarchy.id,
            wp.array(local_points, dtype=wp.vec3, device=device),
            2 * float(np.linalg.norm(np.ptp(everything, axis=0))),
        ],
        outputs=[distances, triangles],
        device=device,
    )
    return ClosestPoints(distances=distances.numpy().astype(np.float64), triangles=triangles.numpy())
