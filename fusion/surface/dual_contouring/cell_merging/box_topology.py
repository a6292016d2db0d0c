"""Whether the surface in a box of eight smaller ones is a disc: then one vertex serves it.

The criterion of Ju, Losasso, Schaefer and Warren ("Dual contouring of Hermite data", 2002, section 4), given that in
each of the eight the surface is a disc, or is not there: from the signs at the 27 corners of these, that in the middle
of an edge of the box is that of one of its ends, in the middle of a face that of one of its four corners, in the middle
of the box that of one of the eight; and by the signs at its own corners the box has one loop and no ambiguous face. So
each of its edges is crossed once at most, and each face by one curve.
"""

import warp as wp

from fusion.surface.dual_contouring.cell_table import CellTables
from fusion.surface.dual_contouring.dual_grid import place_of
from fusion.surface.dual_contouring.faces import is_ambiguous

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def sign_at(signs: int, x: int, y: int, z: int) -> int:
    """Return the sign at one of 27 points, counted from 0 to 2."""
    return (signs >> (x + 3 * y + 9 * z)) & 1


@wp.func
def signs_around(
    inside: wp.array(dtype=wp.uint64), upper: wp.array2d(dtype=int), slot: int, corner: wp.vec3i, half: int
) -> int:
    """Return the signs at the 27 corners of the eight halves of a box, a bit each, 1 inside."""
    signs = int(0)
    for point in range(27):
        at = corner + half * wp.vec3i(point % 3, (point // 3) % 3, point // 9)
        place = place_of(upper, slot, at[0], at[1], at[2])
        signs |= int((inside[place[0]] >> wp.uint64(place[1])) & wp.uint64(1)) << point
    return signs


@wp.func
def agrees(signs: int, x: int, y: int, z: int) -> bool:
    """Return whether a point's sign is that of a corner of the edge, face or box in whose middle it is."""
    own = sign_at(signs, x, y, z)
    for corner in range(8):
        at_x = wp.where(x == 1, 2 * (corner & 1), x)
        at_y = wp.where(y == 1, 2 * ((corner >> 1) & 1), y)
        at_z = wp.where(z == 1, 2 * (corner >> 2), z)
        if sign_at(signs, at_x, at_y, at_z) == own:
            return True
    return False


@wp.func
def corner_signs(signs: int) -> int:
    """Return the signs at the box's own eight corners."""
    case = int(0)
    for corner in range(8):
        case |= sign_at(signs, 2 * (corner & 1), 2 * ((corner >> 1) & 1), 2 * (corner >> 2)) << corner
    return case


@wp.func
def has_ambiguous_face(case: int) -> bool:
    """Return whether a sign pattern has a face with its inside corners across from each other."""
    for axis in range(3):
        u = wp.where(axis == 0, 2, 1)
        v = wp.where(axis == 2, 2, 4)
        for side in range(2):
            corner = side << axis
            pattern = (case >> corner) & 1
            pattern |= ((case >> (corner + u)) & 1) << 1
            pattern |= ((case >> (corner + v)) & 1) << 2
            pattern |= ((case >> (corner + u + v)) & 1) << 3
            if is_ambiguous(pattern):
                return True
    return False


@wp.func
def is_disc(
    inside: wp.array(dtype=wp.uint64),
    upper: wp.array2d(dtype=int),
    tables: CellTables,
    slot: int,
    corner: wp.vec3i,
    half: int,
) -> bool:
    """Return whether the surface in a box of two ``half`` a side is a disc, if it is in its eight halves."""
    signs = signs_around(inside, upper, slot, corner, half)
    case = corner_signs(signs)
    if tables.loop_counts[case] != 1 or has_ambiguous_face(case):
        return False
    fits = bool(True)
    for point in range(27):
        fits = fits and agrees(signs, point % 3, (point // 3) % 3, point // 9)
    return fits
