"""Vertices on the device, and those whose colour and normal come from the vertices around them."""

from dataclasses import dataclass
from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@dataclass(frozen=True, kw_only=True)
class Vertices:
    """Vertices on the device (n,): ``points`` metres in the world, ``colors`` RGB, unit ``normals`` or none (0,)."""

    points: wp.array
    colors: wp.array
    normals: wp.array

    @staticmethod
    def empty(count: int, device: Any, *, normals: bool) -> "Vertices":
        """Return room for vertices."""
        return Vertices(
            points=wp.empty(count, dtype=wp.vec3, device=device),
            colors=wp.empty(count, dtype=wp.vec3ub, device=device),
            normals=wp.empty(count if normals else 0, dtype=wp.vec3, device=device),
        )


@wp.func
def as_bytes(total: wp.vec4) -> wp.vec3ub:
    """Return the average of a sum of colours and their count; black where there are none."""
    scale = 1.0 / wp.max(total[3], 1.0)
    return wp.vec3ub(
        wp.uint8(scale * total[0] + 0.5), wp.uint8(scale * total[1] + 0.5), wp.uint8(scale * total[2] + 0.5)
    )


@wp.func
def set_vertex_between(
    vertex: int,
    point: wp.vec3,
    around: wp.vec4i,
    cell_colors: wp.array(dtype=wp.vec3ub),
    cell_normals: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
    colors: wp.array(dtype=wp.vec3ub),
    normals: wp.array(dtype=wp.vec3),
) -> None:
    """Write a vertex at a point, with the average colour and normal of the cells' vertices around it, −1 for none.

    Normals are left out where there is no room for them.
    """
    normal = wp.vec3()
    color = wp.vec4()
    for i in range(4):
        if around[i] >= 0:
            if cell_normals.shape[0] > 0:
                normal += cell_normals[around[i]]
            own = cell_colors[around[i]]
            color += wp.vec4(float(own[0]), float(own[1]), float(own[2]), 1.0)
    points[vertex] = point
    colors[vertex] = as_bytes(color)
    if normals.shape[0] > 0:
        normals[vertex] = wp.normalize(normal)
