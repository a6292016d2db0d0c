"""A closed surface with normals and places on pictures."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int32]


@dataclass(frozen=True, kw_only=True)
class Solid:
    """A closed surface, its faces counter-clockwise from outside.

    ``vertices`` (V, 3) metres; ``normals`` (V, 3) for shading, or None for flat faces; ``sizes`` (F,) corners of each
    face, whose vertices follow each other in ``corners`` (L,); ``uv_metres`` (L, 2) places on a picture that repeats,
    grain along u, and ``uv_unit`` (L, 2) on one that is stretched over all; ``slots`` (F,) which material.
    """

    vertices: Array
    normals: Array | None
    sizes: Indices
    corners: Indices
    uv_metres: Array
    uv_unit: Array
    slots: Indices


def joined(solids: Sequence[Solid]) -> Solid:
    """Return several solids, all with normals or none, as one; they stay closed each for itself."""
    starts = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    normals = [solid.normals for solid in solids if solid.normals is not None]
    return Solid(
        vertices=np.concatenate([solid.vertices for solid in solids]),
        normals=np.concatenate(normals) if len(normals) == len(solids) else None,
        sizes=np.concatenate([solid.sizes for solid in solids]),
        corners=np.concatenate([solid.corners + start for solid, start in zip(solids, starts, strict=False)]),
        uv_metres=np.concatenate([solid.uv_metres for solid in solids]),
        uv_unit=np.concatenate([solid.uv_unit for solid in solids]),
        slots=np.concatenate([solid.slots for solid in solids]),
    )


def triangles_of(solid: Solid) -> Indices:
    """Return the faces, each cut into a fan, as triangles (T, 3)."""
    fans = []
    start = 0
    for size in solid.sizes:
        face = solid.corners[start : start + size]
        fans += [(face[0], face[i], face[i + 1]) for i in range(1, size - 1)]
        start += size
    return np.array(fans, np.int32)


def enclosed_volume(solid: Solid) -> float:
    """Return the volume in m³, negative where the faces look inwards (divergence theorem)."""
    a, b, c = (solid.vertices[corner] for corner in triangles_of(solid).T)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def facing_outwards(solid: Solid) -> Solid:
    """Return the solid with its faces and normals turned about where they look inwards."""
    if enclosed_volume(solid) >= 0:
        return solid
    ends = np.cumsum(solid.sizes)
    order = np.concatenate(
        [np.arange(end - 1, end - size - 1, -1) for size, end in zip(solid.sizes, ends, strict=True)]
    )
    return Solid(
        vertices=solid.vertices,
        normals=None if solid.normals is None else -solid.normals,
        sizes=solid.sizes,
        corners=solid.corners[order],
        uv_metres=solid.uv_metres[order],
        uv_unit=solid.uv_unit[order],
        slots=solid.slots,
    )
