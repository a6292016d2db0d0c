import itertools

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from fusion.surface.dual_contouring.cell_table import NO_VERTEX, cell_table
from fusion.surface.marching_cubes_table import CORNERS, EDGE_CORNERS


def loops_of(case):
    table = cell_table()
    ends = [0, *table.loop_ends[case, : table.loop_counts[case]]]
    return [table.edges[case, a:b].tolist() for a, b in itertools.pairwise(ends)]


@pytest.mark.parametrize("case", range(256))
def test_each_crossed_edge_is_in_one_loop(case):
    crossed = {e for e, (a, b) in enumerate(EDGE_CORNERS.tolist()) if (case >> a & 1) != (case >> b & 1)}
    loops = loops_of(case)
    assert sorted(itertools.chain(*loops)) == sorted(crossed)
    code = int(cell_table().codes[case])
    numbers = {edge: number for number, loop in enumerate(loops) for edge in loop}
    assert [code >> 4 * edge & 15 for edge in range(12)] == [numbers.get(edge, NO_VERTEX) for edge in range(12)]


@pytest.mark.parametrize("case", [case for case in range(256) if cell_table().loop_counts[case] > 1])
def test_the_hulls_of_a_cells_loops_have_no_inner_point_in_common(case):
    # What keeps sheets in one cell apart: no ball fits into two hulls at once.
    hulls = [ConvexHull(CORNERS[np.unique(EDGE_CORNERS[loop])].astype(float)).equations for loop in loops_of(case)]
    for one, other in itertools.combinations(hulls, 2):
        planes = np.concatenate([one, other])
        ball = linprog(
            [0, 0, 0, -1],
            A_ub=np.column_stack([planes[:, :3], np.ones(len(planes))]),
            b_ub=-planes[:, 3],
            bounds=[(None, None)] * 4,
        )
        assert -ball.fun <= 1e-9


def test_both_cells_at_a_face_number_its_curves_alike():
    table = cell_table()
    seen = {}
    for case in range(256):
        ends = [0, *table.loop_ends[case, : table.loop_counts[case]]]
        for start, end in itertools.pairwise(ends):
            for i in range(start, end):
                face, curve, second = (
                    table.curves[case, i] >> 2,
                    table.curves[case, i] >> 1 & 1,
                    table.curves[case, i] & 1,
                )
                axis, side = divmod(int(face), 2)
                following = table.edges[case, i + 1 if i + 1 < end else start]
                pair = [table.edges[case, i], following]
                points = [tuple(np.delete(CORNERS[EDGE_CORNERS[edge]].mean(0), axis)) for edge in pair]
                signs = tuple(case >> c & 1 for c in range(8) if CORNERS[c][axis] == side)
                first_end = points[second]
                assert seen.setdefault((axis, signs, int(curve)), (frozenset(points), first_end)) == (
                    frozenset(points),
                    first_end,
                )
    # Of the 14 mixed patterns of a face two are ambiguous.
    assert len(seen) == 3 * (12 + 2 * 2)
