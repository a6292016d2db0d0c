"""Thin triangles: what a renderer, a simulation or a person who edits a mesh dislikes about it."""

import numpy as np

from fusion.surface.mesh import Mesh

THIN_DEG = 10.0


def thin_share(mesh: Mesh, *, below_deg: float = THIN_DEG) -> float:
    """Return the share of triangles whose smallest angle is below ``below_deg`` degrees; those of no area are."""
    a, b, c = np.moveaxis(mesh.vertices.astype(np.float64)[mesh.triangles], 1, 0)
    sides = np.sort([np.linalg.norm(b - a, axis=1), np.linalg.norm(c - b, axis=1), np.linalg.norm(a - c, axis=1)], 0)
    # The smallest angle lies between the two longest sides, opposite the shortest.
    twice_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    sine = twice_area / np.maximum(sides[1] * sides[2], 1e-300)
    return float((sine < np.sin(np.radians(below_deg))).mean())
