"""Random solids: boxes, ellipsoids, cylinders and rings, joined or cut out of each other, whose numbers make them."""

import numpy as np
from scipy import ndimage
from skimage.measure import marching_cubes

from datagen.rigid import inverse, transform_points
from fusion.pose.se3 import exp_se3
from fusion.surface.mesh import Mesh

TWIN = 4 / 3
"""How much larger a twin's last part is."""

_NODES = 96


def ellipsoid(points, size):
    return (np.linalg.norm(points / size, axis=-1) - 1) * size.min()


def box(points, size):
    return (np.abs(points) - size).max(axis=-1)


def cylinder(points, size):
    return np.maximum(np.hypot(points[..., 0], points[..., 1]) - size[0], np.abs(points[..., 2]) - size[2])


def ring(points, size):
    around = np.hypot(points[..., 0], points[..., 1]) - size.max()
    return np.hypot(around, points[..., 2]) - 0.35 * size.max()


def random_solid(number, *, twin=False):
    """Return the mesh of a random solid, 0.2 to 0.3 m large; a twin's last part is larger."""
    rng = np.random.default_rng(number)
    line = np.linspace(-1, 1, _NODES)
    grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1)
    parts, inside = int(rng.integers(2, 5)), None
    for part in range(parts):
        size = rng.uniform(0.12, 0.45, 3) * (TWIN if twin and part == parts - 1 else 1)
        place = np.eye(4) if part == 0 else exp_se3(np.concatenate([np.zeros(3), rng.normal(size=3)]))
        place[:3, 3] = 0 if part == 0 else rng.uniform(-0.35, 0.35, 3)
        shape = (box, ellipsoid, cylinder, ring)[rng.integers(4)]
        value = shape(transform_points(inverse(place), grid.reshape(-1, 3)).reshape(grid.shape), size)
        cut = part > 0 and rng.random() < 0.25
        inside = value if inside is None else np.maximum(inside, -value) if cut else np.minimum(inside, value)
    # One piece, the largest: what floats beside it is no part of an object.
    pieces, count = ndimage.label(inside < 0)
    sizes = ndimage.sum_labels(inside < 0, pieces, np.arange(1, count + 1))
    alone = np.where((inside < 0) & (pieces != 1 + int(np.argmax(sizes))), -inside, inside)
    alone = np.pad(alone, 1, constant_values=1.0)
    vertices, triangles, _normals, _values = marching_cubes(alone, 0.0)
    vertices = vertices * (line[1] - line[0])
    return centred(vertices, triangles, rng.uniform(0.2, 0.3))


def centred(vertices, triangles, diameter):
    extent = np.ptp(vertices, axis=0)
    vertices = (vertices - vertices.min(axis=0) - extent / 2) * (diameter / np.linalg.norm(extent))
    return Mesh(vertices=vertices.astype(np.float32), triangles=np.ascontiguousarray(triangles, np.int32))
