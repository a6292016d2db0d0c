"""What becomes of quads where boxes take the place of cells.

Around an edge that lies within a face of two boxes, or within one, there is nothing; where three boxes or cells meet
there is a triangle, else a quad, as in Ju's and others' dual contouring of octrees. They stay within the *envelope* of
the edge on which their boxes meet, which is as long as the smallest of them (Ju and Udeshi, "Intersection-free
contouring on an octree grid", 2006): the tetrahedra of its two ends and the vertices of two successive boxes. The
envelopes of all edges fill space without overlap if the straight line between two boxes' vertices leads through the
face that they have in common. Of cells that is always so; where it is not, the larger box is refused, to be split. A
triangle that the edge does not pierce becomes a fan around the 1-D point, as a quad without an allowed diagonal does.

Coordinates are from the low end of the quad's own edge between voxels: along the second and third axis, and the edge's.
"""

import warp as wp

from fusion.surface.dual_contouring.cell_merging.boxes import Boxes
from fusion.surface.dual_contouring.dual_grid import DualGrid, complete_along
from fusion.surface.dual_contouring.lanes import ONE_LANE_IN_CPP
from fusion.surface.dual_contouring.quad_split import FAN, NOTHING, SPLIT_IN_CPP, WITHOUT_CORNER
from fusion.surface.layers import NONE, launch_over_layers, lowest_bit, vertex_number

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_CHOOSE_IN_CPP = (
    ONE_LANE_IN_CPP
    + SPLIT_IN_CPP
    + """
    const Point corners[4] = {{a[0], a[1], a[2]}, {b[0], b[1], b[2]}, {c[0], c[1], c[2]}, {d[0], d[1], d[2]}};
    return (int)choose_split(corners, along);
"""
)


@wp.func_native(_CHOOSE_IN_CPP)
def split_of(inset: float, a: wp.vec3, b: wp.vec3, c: wp.vec3, d: wp.vec3, along: float) -> int:
    """Return how a quad around an edge from 0 to 1 is cut."""


@wp.struct
class Corner:
    """Of a quad: the box's lowest corner, its side and its vertex, in the quad's coordinates."""

    low: wp.vec3i
    side: int
    point: wp.vec3


@wp.func
def corner_of(boxes: Boxes, vertex: int, voxel: wp.vec3i, axis: int, corner: int) -> Corner:
    """Return a quad's corner, from the vertex of the cell there and the voxel of the edge, both in their block."""
    second = (axis + 1) % 3
    third = (axis + 2) % 3
    cell = voxel
    if corner == 1 or corner == 2:
        cell[second] = cell[second] - 1
    if corner >= 2:
        cell[third] = cell[third] - 1
    found = Corner()
    found.side = 1 << int(boxes.levels[vertex])
    low = wp.vec3i()
    for i in range(3):
        low[i] = (cell[i] & -found.side) - voxel[i]
    place = boxes.owner_places[vertex]
    found.low = wp.vec3i(low[second], low[third], low[axis])
    found.point = wp.vec3(float(low[second]), float(low[third]), float(low[axis])) + wp.vec3(
        place[second], place[third], place[axis]
    )
    return found


@wp.func
def leads_through_face(a: Corner, b: Corner, across: int, inset: float) -> bool:
    """Return whether the line between two boxes' vertices passes the face that they share, across an axis at 0."""
    if a.side == b.side:
        return True
    smaller = a
    if b.side < a.side:
        smaller = b
    share = a.point[across] / (a.point[across] - b.point[across])
    point = a.point + share * (b.point - a.point)
    for i in range(3):
        if i != across:
            along = point[i] - float(smaller.low[i])
            if along < 0.5 * inset or along > float(smaller.side) - 0.5 * inset:
                return False
    return True


@wp.func
def pierced_at(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> float:
    """Return where a triangle around the edge's line passes it."""
    at_a = b[0] * c[1] - b[1] * c[0]
    at_b = c[0] * a[1] - c[1] * a[0]
    at_c = a[0] * b[1] - a[1] * b[0]
    return (at_a * a[2] + at_b * b[2] + at_c * c[2]) / (at_a + at_b + at_c)


@wp.func
def along_edge(point: wp.vec3, low: int, side: int) -> wp.vec3:
    """Return a point whose last coordinate is from 0 to 1 along the edge on which boxes meet."""
    return wp.vec3(point[0], point[1], (point[2] - float(low)) / float(side))


@wp.func
def changed_near(grid: DualGrid, boxes: Boxes, slot: int) -> bool:
    """Return whether a box at a block's quads was split last."""
    for corner in range(8):
        holder = grid.cells.lower[slot, corner]
        if holder >= 0 and boxes.changed[holder] != wp.uint8(0):
            return True
    return False


@wp.kernel
def _cut(
    first: int,
    grid: DualGrid,
    along: wp.array(dtype=float),
    corners: wp.array(dtype=wp.vec4i),
    boxes: Boxes,
    cell_splits: wp.array(dtype=wp.uint8),
    splits: wp.array(dtype=wp.uint8),
) -> None:
    layer = wp.tid() + first
    quad = grid.quad_starts[layer]
    if quad == grid.quad_starts[layer + 1] or not changed_near(grid, boxes, layer >> 3):
        return
    for axis in range(3):
        left = complete_along(grid, layer, axis)
        while left != NONE:
            bit = lowest_bit(left)
            crossed_at = along[vertex_number(grid.cells, layer, axis, bit)]
            voxel = wp.vec3i(bit & 7, bit >> 3, layer & 7)
            splits[quad] = wp.uint8(cut_of(grid, boxes, corners[quad], voxel, axis, crossed_at, cell_splits[quad]))
            quad += 1
            left = left & (left - wp.uint64(1))


@wp.func
def cut_of(
    grid: DualGrid,
    boxes: Boxes,
    cells: wp.vec4i,
    voxel: wp.vec3i,
    axis: int,
    crossed_at: float,
    as_cells: wp.uint8,
) -> int:
    """Return how a quad between cells' vertices is cut, and refuse boxes that it does not fit."""
    largest = int(0)
    same = int(0)
    at_same = int(-1)
    for i in range(4):
        largest = wp.max(largest, int(boxes.levels[cells[i]]))
        if boxes.owners[cells[i]] == boxes.owners[cells[(i + 1) & 3]]:
            same += 1
            at_same = i
    if largest == 0:
        return int(as_cells)
    if same > 1:
        return NOTHING
    ring0 = corner_of(boxes, cells[0], voxel, axis, 0)
    ring1 = corner_of(boxes, cells[1], voxel, axis, 1)
    ring2 = corner_of(boxes, cells[2], voxel, axis, 2)
    ring3 = corner_of(boxes, cells[3], voxel, axis, 3)
    fits = check(boxes, cells, 0, ring0, ring1, at_same, grid.inset)
    fits = check(boxes, cells, 1, ring1, ring2, at_same, grid.inset) and fits
    fits = check(boxes, cells, 2, ring2, ring3, at_same, grid.inset) and fits
    fits = check(boxes, cells, 3, ring3, ring0, at_same, grid.inset) and fits
    if not fits:
        return FAN
    # The edge on which all of them meet is the smallest one's.
    side = ring0.side
    low = ring0.low[2]
    if ring1.side < side:
        side = ring1.side
        low = ring1.low[2]
    if ring2.side < side:
        side = ring2.side
        low = ring2.low[2]
    if ring3.side < side:
        side = ring3.side
        low = ring3.low[2]
    margin = grid.inset / float(side)
    a = along_edge(ring0.point, low, side)
    b = along_edge(ring1.point, low, side)
    c = along_edge(ring2.point, low, side)
    d = along_edge(ring3.point, low, side)
    if same == 0:
        return split_of(margin, a, b, c, d, (crossed_at - float(low)) / float(side))
    if at_same == 0:
        b = c
        c = d
    if at_same == 1:
        c = d
    height = pierced_at(a, b, c)
    if height < 0.5 * margin or height > 1.0 - 0.5 * margin:
        return FAN
    return WITHOUT_CORNER + at_same


@wp.func
def check(boxes: Boxes, cells: wp.vec4i, i: int, a: Corner, b: Corner, at_same: int, inset: float) -> bool:
    """Return whether a corner's and the next one's vertices see each other; else refuse the larger box."""
    if i == at_same or leads_through_face(a, b, i & 1, inset):
        return True
    larger = cells[i]
    if b.side > a.side:
        larger = cells[(i + 1) & 3]
    boxes.refused[boxes.owners[larger]] = wp.uint8(1)
    return False


def cut_quads_of_boxes(
    grid: DualGrid, along: wp.array, corners: wp.array, boxes: Boxes, cell_splits: wp.array, splits: wp.array
) -> None:
    """Write how quads are cut (``quad_split``), from how those between cells are; boxes that do not fit are refused.

    What is far from boxes that were split last stays as it is.
    """
    launch_over_layers(
        _cut,
        dim=len(grid.several),
        inputs=[grid, along, corners, boxes, cell_splits],
        outputs=[splits],
        device=corners.device,
    )
