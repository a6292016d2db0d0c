import numpy as np
import pytest

from fusion.surface.marching_cubes_table import CORNERS, EDGE_CORNERS, triangle_table


def corner_inside(case):
    return [bool(case >> corner & 1) for corner in range(8)]


@pytest.mark.parametrize("case", range(256))
def test_triangles_use_exactly_the_edges_whose_signs_differ(case):
    counts, table = triangle_table()
    inside = corner_inside(case)
    crossed = {edge for edge, (a, b) in enumerate(EDGE_CORNERS) if inside[a] != inside[b]}
    assert set(table[case, : 3 * counts[case]]) == crossed
    assert (table[case, 3 * counts[case] :] == -1).all()


@pytest.mark.parametrize("case", range(1, 255))
def test_each_case_bounds_its_inside_corners(case):
    # The signed volume under the surface, closed by the cell's faces, tells the orientation: the inside is behind it.
    counts, table = triangle_table()
    middles = CORNERS[EDGE_CORNERS].mean(1)
    inside = corner_inside(case)
    for a, b, c in table[case, : 3 * counts[case]].reshape(-1, 3):
        normal = np.cross(middles[b] - middles[a], middles[c] - middles[a])
        # Along each of the triangle's cell edges, outwards is from the inside corner to the outside one.
        outwards = sum(
            (CORNERS[high] - CORNERS[low]) * (1 if inside[low] else -1) for low, high in EDGE_CORNERS[[a, b, c]]
        )
        assert normal @ outwards > 0


def test_cells_that_share_a_face_cut_it_along_the_same_segments():
    counts, table = triangle_table()
    middles = CORNERS[EDGE_CORNERS].mean(1)

    def boundary_on_face(case, axis, side):
        """Return the surface's segments in a face, as pairs of points, directed."""
        segments = {}
        for triangle in table[case, : 3 * counts[case]].reshape(-1, 3):
            for a, b in zip(triangle, np.roll(triangle, -1), strict=True):
                if middles[a][axis] == side and middles[b][axis] == side:
                    key = tuple(np.delete(middles[a], axis)), tuple(np.delete(middles[b], axis))
                    if key[::-1] in segments:
                        del segments[key[::-1]]
                    else:
                        segments[key] = True
        return set(segments)

    for axis in range(3):
        by_signs = {}
        for case in range(256):
            inside = corner_inside(case)
            for side in (0, 1):
                signs = tuple(inside[c] for c in range(8) if CORNERS[c][axis] == side)
                segments = boundary_on_face(case, axis, side)
                directed = segments if side == 0 else {pair[::-1] for pair in segments}
                assert by_signs.setdefault(signs, directed) == directed
