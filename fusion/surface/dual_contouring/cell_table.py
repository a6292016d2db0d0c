"""How the surface runs through a cell, for each of the 256 sign patterns: derived from marching cubes' own loops.

The surface leaves a cell along closed loops on its faces. Each loop has a vertex of its own, so that no vertex joins
two sheets. Corners and edges are numbered as in ``marching_cubes_table``; face 2·axis + side lies across ``axis``.

Within a face, u and v are the other two axes, ascending. The surface runs through it along one curve, or along two
where the face is ambiguous: these go around the inside corners, and curve 0 around the one with v = 0. Face edges are 0
and 1, along u at v = 0 and 1, and 2 and 3, along v at u = 0 and 1. So both cells at a face number its curves alike.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp
from numpy.typing import NDArray

from fusion.surface.marching_cubes_table import CORNERS, EDGE_CORNERS, surface_loops

MOST_LOOPS = 4
NO_VERTEX = 15
"""Stands in a cell's code for an edge without a vertex."""
COUNT_SHIFT = 48
"""At which bit of a code the number of the cell's vertices stands."""


@dataclass(frozen=True, kw_only=True)
class CellTable:
    """The 256 cases.

    ``loop_counts`` (256,); ``loop_ends`` (256, 4) where each loop ends among ``edges`` (256, 12), which has them one
    after the other, −1 beyond; ``curves`` (256, 12) is 4·face + 2·curve, along which the loop goes on from an edge to
    the next, + 1 where it goes there from the curve's second end to its first: the ends are in the order of face edges.
    ``codes`` (256,) uint64 has at bits 4·edge … the number of the loop that an edge is in, or NO_VERTEX, and above
    these, from COUNT_SHIFT on, the number of loops.
    """

    loop_counts: NDArray[np.int32]
    loop_ends: NDArray[np.int32]
    edges: NDArray[np.int32]
    curves: NDArray[np.int32]
    codes: NDArray[np.uint64]


def _face_curve(inside: list[bool], first: int, second: int) -> int:
    """Return 4·face + 2·curve of the one face on which two edges lie, + 1 where the first is the curve's second end."""
    corners = [CORNERS[c] for edge in (first, second) for c in EDGE_CORNERS[edge]]
    ((axis, side),) = [(a, int(corners[0][a])) for a in range(3) if len({int(corner[a]) for corner in corners}) == 1]
    u, v = (a for a in range(3) if a != axis)
    on_face = {(int(c[u]), int(c[v])): inside[i] for i, c in enumerate(CORNERS) if c[axis] == side}
    ambiguous = on_face[0, 0] == on_face[1, 1] != on_face[0, 1] == on_face[1, 0]
    # The corner that both edges meet at; on an ambiguous face it is inside.
    common = {tuple(c) for c in CORNERS[EDGE_CORNERS[first]]} & {tuple(c) for c in CORNERS[EDGE_CORNERS[second]]}
    curve = int(next(iter(common))[v]) if ambiguous else 0
    ends = [_face_edge(edge, u, v) for edge in (first, second)]
    return 4 * (2 * axis + side) + 2 * curve + int(ends[0] > ends[1])


def _face_edge(edge: int, u: int, v: int) -> int:
    """Return which of a face's edges an edge of the cell is."""
    low = CORNERS[EDGE_CORNERS[edge, 0]]
    return int(low[v]) if edge // 4 == u else 2 + int(low[u])


@cache
def cell_table() -> CellTable:
    """Return the table, derived from the loops of each sign pattern."""
    loop_counts = np.zeros(256, np.int32)
    loop_ends = np.zeros((256, MOST_LOOPS), np.int32)
    edges, curves = np.full((256, 12), -1, np.int32), np.full((256, 12), -1, np.int32)
    codes = np.zeros(256, np.uint64)
    for case in range(256):
        inside = [bool(case >> corner & 1) for corner in range(8)]
        number_of_edge = [NO_VERTEX] * 12
        end = 0
        loops = sorted(surface_loops(inside), key=min)
        for number, loop in enumerate(loops):
            for edge, following in zip(loop, loop[1:] + loop[:1], strict=True):
                edges[case, end], curves[case, end] = edge, _face_curve(inside, edge, following)
                number_of_edge[edge] = number
                end += 1
            loop_ends[case, number:] = end
        loop_counts[case] = len(loops)
        codes[case] = sum(number << 4 * edge for edge, number in enumerate(number_of_edge))
        codes[case] |= np.uint64(len(loops) << COUNT_SHIFT)
    return CellTable(loop_counts=loop_counts, loop_ends=loop_ends, edges=edges, curves=curves, codes=codes)


@wp.struct
class CellTables:
    """``CellTable`` on a device, ``ends`` with 0 before each case's first: (256, 5)."""

    loop_counts: wp.array(dtype=int)
    ends: wp.array2d(dtype=int)
    edges: wp.array2d(dtype=int)
    curves: wp.array2d(dtype=int)
    codes: wp.array(dtype=wp.uint64)


@cache
def cell_tables(device: str) -> CellTables:
    """Return the table on a device, named by its alias."""
    table = cell_table()
    tables = CellTables()
    tables.loop_counts = wp.array(table.loop_counts, dtype=int, device=device)
    tables.ends = wp.array(np.pad(table.loop_ends, ((0, 0), (1, 0))), dtype=int, device=device)
    tables.edges = wp.array(table.edges, dtype=int, device=device)
    tables.curves = wp.array(table.curves, dtype=int, device=device)
    tables.codes = wp.array(table.codes, dtype=wp.uint64, device=device)
    return tables
