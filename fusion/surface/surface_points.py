"""The surface as points, with normals and colours: a mesh's vertices."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.atomic_write import write_bytes
from fusion.surface.mesh import Mesh

_PLY_TYPES = {"<f4": "float", "u1": "uchar"}
_PLY_PROPERTIES = dict.fromkeys(("x", "y", "z", "nx", "ny", "nz"), "<f4") | dict.fromkeys(
    ("red", "green", "blue"), "u1"
)


@dataclass(frozen=True, kw_only=True)
class PointCloud:
    """Points of a surface in the world frame.

    ``points`` (n, 3) float32 metres; ``normals`` (n, 3) float32 of length 1, out of the surface; ``colors`` (n, 3)
    uint8 RGB, sRGB-encoded as in the images.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8]


def points_of(mesh: Mesh) -> PointCloud:
    """Return the vertices of a mesh that has normals and colours."""
    assert mesh.normals is not None
    assert mesh.colors is not None
    return PointCloud(points=mesh.vertices, normals=mesh.normals, colors=mesh.colors)


def write_points(path: Path, cloud: PointCloud) -> None:
    """Write points atomically as binary PLY, with normals, which trimesh leaves out of point clouds."""
    table = np.empty(len(cloud.points), list(_PLY_PROPERTIES.items()))
    columns = [*cloud.points.T, *cloud.normals.T, *cloud.colors.T]
    properties = ""
    for (name, kind), values in zip(_PLY_PROPERTIES.items(), columns, strict=True):
        table[name] = values
        properties += f"property {_PLY_TYPES[kind]} {name}\n"
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(table)}\n{properties}end_header\n"
    write_bytes(path, header.encode() + table.tobytes())
