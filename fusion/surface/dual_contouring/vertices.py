"""Vertices on the device, and those whose colour and normal come from the vertices around them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.struct
class VertexArrays:
    """``Vertices`` for kernels."""

    points: wp.array(dtype=wp.vec3)
    colors: wp.array(dtype=wp.vec3ub)
    normals: wp.array(dtype=wp.vec3)


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

    def arrays(self) -> VertexArrays:
        """Return them as kernels take them."""
        arrays = VertexArrays()
        arrays.points, arrays.colors, arrays.normals = self.points, self.colors, self.normals
        return arrays

    def part(self, start: int, end: int) -> "Vertices":
        """Return the vertices from one number to before another, where they lie."""
        some = slice(start, end)
        normals = self.normals[some] if len(self.normals) else self.normals
        return Vertices(points=self.points[some], colors=self.colors[some], normals=normals)


class VertexRoom:
    """Room for vertices that follow each other, so that a mesh need not be put together from parts.

    Vertices beyond the ``count`` that were expected have room of their own.
    """

    def __init__(self, count: int, device: Any, *, normals: bool) -> None:
        self.normals = normals
        self._device = device
        self._whole = Vertices.empty(count, device, normals=normals)
        self._parts: list[Vertices] = []
        self._taken = 0

    def take(self, count: int) -> Vertices:
        """Return room for the next vertices."""
        end = self._taken + count
        if count > 0 and end <= len(self._whole.points):  # there are no empty slices
            part = self._whole.part(self._taken, end)
        else:
            part = Vertices.empty(count, self._device, normals=self.normals)
        self._parts.append(part)
        self._taken = end
        return part

    def taken(self, name: str) -> np.ndarray:
        """Return on the host what was taken, of ``points``, ``colors`` or ``normals``."""
        if 0 < self._taken <= len(self._whole.points):
            return getattr(self._whole, name)[: self._taken].numpy()
        return np.concatenate([getattr(part, name).numpy() for part in self._parts])


@wp.func
def as_bytes(total: wp.vec4) -> wp.vec3ub:
    """Return the average of a sum of colours and their count; black where there are none."""
    scale = 1.0 / wp.max(total[3], 1.0)
    return wp.vec3ub(
        wp.uint8(scale * total[0] + 0.5), wp.uint8(scale * total[1] + 0.5), wp.uint8(scale * total[2] + 0.5)
    )


@wp.func
def set_vertex_between(
    vertex: int, point: wp.vec3, around: wp.vec4i, cells: VertexArrays, vertices: VertexArrays
) -> None:
    """Write a vertex at a point, with the average colour and normal of the ``cells``' around it, −1 for none.

    Normals are left out where there is no room for them.
    """
    normal = wp.vec3()
    color = wp.vec4()
    for i in range(4):
        if around[i] >= 0:
            if cells.normals.shape[0] > 0:
                normal += cells.normals[around[i]]
            own = cells.colors[around[i]]
            color += wp.vec4(float(own[0]), float(own[1]), float(own[2]), 1.0)
    vertices.points[vertex] = point
    vertices.colors[vertex] = as_bytes(color)
    if vertices.normals.shape[0] > 0:
        vertices.normals[vertex] = wp.normalize(normal)
