"""The marching cubes cases, derived and not copied: for each of the 256 sign patterns of a cell, its triangles.

Corner c of a cell lies at (c & 1, c >> 1 & 1, c >> 2 & 1). Edge 4·axis + k runs along ``axis`` from ``EDGE_CORNERS``'
first corner to its second. On each face, every run of inside corners is cut off by one segment, so an ambiguous face
always separates its two inside corners: both cells at a face decide alike, from its four signs alone, and the surface
of a closed field is closed. The segments join to loops, the loops are cut into triangles. Diagonals that would lie
within a face are avoided, since the neighbouring cell could draw the same one and give an edge four triangles.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

CORNERS = np.array([(c & 1, c >> 1 & 1, c >> 2 & 1) for c in range(8)])

EDGE_CORNERS = np.array(
    [(low, low | 1 << axis) for axis in range(3) for low in range(8) if not low >> axis & 1], dtype=np.int32
)
"""The two corners of each of the 12 edges; the first has the smaller coordinate along the edge's axis."""

_EDGE_OF_CORNERS = {tuple(sorted(corners)): edge for edge, corners in enumerate(EDGE_CORNERS.tolist())}

Loop = list[int]
Triangle = tuple[int, int, int]


def _faces() -> list[list[int]]:
    """Return the corners of the six faces, each counter-clockwise seen from outside."""
    faces = []
    for axis in range(3):
        one, two = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        for offset in (0, 1 << axis):
            cycle = [offset, offset | one, offset | one | two, offset | two]
            faces.append(cycle if offset else cycle[::-1])
    return faces


_FACES = _faces()
_FACES_OF_EDGE = [
    {face for face, cycle in enumerate(_FACES) if set(corners) <= set(cycle)} for corners in EDGE_CORNERS.tolist()
]


def surface_loops(inside: list[bool]) -> list[Loop]:
    """Return the surface's boundary on the cell as closed loops of edges, outside on their left seen from outside."""
    follows: dict[int, int] = {}
    for cycle in _FACES:
        crossings = [
            (_EDGE_OF_CORNERS[min(a, b), max(a, b)], inside[b])
            for a, b in zip(cycle, cycle[1:] + cycle[:1], strict=True)
            if inside[a] != inside[b]
        ]
        # An edge that enters the inside is joined to the next one around, which leaves it.
        for i, (edge, enters) in enumerate(crossings):
            if enters:
                follows[edge] = crossings[(i + 1) % len(crossings)][0]
    loops = []
    while follows:
        start, edge = follows.popitem()
        loop = [start]
        while edge != start:
            loop.append(edge)
            edge = follows.pop(edge)
        loops.append(loop)
    return loops


def _triangulate(loop: Loop) -> list[Triangle]:
    """Cut a loop into triangles, with as few diagonals within a face as can be."""

    @cache
    def best(first: int, last: int) -> tuple[int, tuple[Triangle, ...]]:
        if last - first < 2:
            return 0, ()
        options = []
        for middle in range(first + 1, last):
            cost_a, left = best(first, middle)
            cost_b, right = best(middle, last)
            cost = sum(
                b - a > 1 and bool(_FACES_OF_EDGE[loop[a]] & _FACES_OF_EDGE[loop[b]])
                for a, b in ((first, middle), (middle, last))
            )
            options.append((cost_a + cost_b + cost, (*left, *right, (loop[first], loop[middle], loop[last]))))
        return min(options)

    return list(best(0, len(loop) - 1)[1])


@cache
def triangle_table() -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the number of triangles (256,) and their edges (256, 3 · most) of each case, padded with −1.

    Bit c of a case is set where corner c is inside (a negative distance). Triangles are counter-clockwise seen from
    outside the surface.
    """
    cases = []
    for case in range(256):
        loops = surface_loops([bool(case >> corner & 1) for corner in range(8)])
        cases.append([edge for loop in loops for triangle in _triangulate(loop) for edge in triangle])
    counts = np.array([len(edges) // 3 for edges in cases], dtype=np.int32)
    table = np.full((256, 3 * counts.max()), -1, dtype=np.int32)
    for case, edges in enumerate(cases):
        table[case, : len(edges)] = edges
    return counts, table
