"""Which vertices on pinned faces a quad passes."""

import warp as wp

from fusion.surface.dual_contouring.dual_grid import DualGrid, pin_number, place_of
from fusion.surface.dual_contouring.faces import curve_from, face_u, pattern_of
from fusion.surface.layers import NONE, step_along

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def pin_beside(grid: DualGrid, slot: int, voxel: wp.vec3i, axis: int, normal: int, side: int) -> int:
    """Return the number of the vertex that a quad passes on a face across ``normal`` from a voxel, −1 for none.

    The quad's edge runs along ``axis`` on the low (0) or high (1) ``side`` of the face.
    """
    place = place_of(grid.cells.lower, slot, voxel[0], voxel[1], voxel[2])
    layer = place[0]
    if layer < 0:
        return -1
    if grid.pin_starts[layer] == grid.pin_starts[layer + 1]:
        return -1
    one = wp.uint64(1) << wp.uint64(place[1])
    if ((grid.pins[2 * layer, normal] | grid.pins[2 * layer + 1, normal]) & one) == NONE:
        return -1
    holder = wp.vec3i(place[1] & 7, place[1] >> 3, layer & 7)
    pattern = pattern_of(grid, layer >> 3, holder, normal)
    return pin_number(grid, layer, normal, place[1], curve_from(pattern, axis == face_u(normal), side))


@wp.func
def pins_around(grid: DualGrid, slot: int, z: int, bit: int, axis: int) -> wp.vec4i:
    """Return the numbers of the vertices on the faces between a quad's corner and the next, −1 for none."""
    voxel = wp.vec3i(bit & 7, bit >> 3, z)
    second = (axis + 1) % 3
    third = (axis + 2) % 3
    return wp.vec4i(
        pin_beside(grid, slot, voxel, axis, second, 0),
        pin_beside(grid, slot, voxel - step_along(second), axis, third, 1),
        pin_beside(grid, slot, voxel - step_along(third), axis, second, 1),
        pin_beside(grid, slot, voxel, axis, third, 0),
    )


@wp.func
def has_pins(grid: DualGrid, slot: int, z: int) -> bool:
    """Return whether a layer's quads may pass a vertex on a face."""
    for back in range(8):
        holder = grid.cells.lower[slot, (back & 3) | wp.where(z == 0, back & 4, 0)]
        if holder >= 0:
            layer = 8 * holder + ((z - (back >> 2)) & 7)
            if grid.pin_starts[layer] != grid.pin_starts[layer + 1]:
                return True
    return False
