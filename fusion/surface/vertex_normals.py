"""Normals of a surface's vertices, from the gradient of the field that it is the zero level of.

At a voxel the gradient of the average distance is the central difference along each axis, the one-sided difference
where only one neighbour was seen, and 0 where none was. At a vertex it is interpolated as the vertex itself is, between
the ends of its voxel edge.
"""

import warp as wp

from fusion.devices import launch_in_slabs
from fusion.surface.layers import NONE, Cells, lowest_bit, number_of, share_of, shares_on, step_along, vertex_number
from fusion.volume.block_table import BLOCK_VOXELS, find_block
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxels import Voxels, distance_of, weight_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_VOXELS = wp.constant(BLOCK_VOXELS)


@wp.struct
class Field:
    """The voxels of a volume, to be read anywhere; those of weight over ``min_weight`` were seen."""

    keys: wp.array(dtype=wp.int64)
    numbers: wp.array(dtype=int)
    voxels: Voxels
    min_weight: float


@wp.func
def seen_voxel(field: Field, home: wp.vec3i, home_number: int, point: wp.vec3i) -> int:
    """Return the index of the voxel at a lattice point, −1 where it was not seen; fastest in the block ``home``."""
    block = wp.vec3i(point[0] >> 3, point[1] >> 3, point[2] >> 3)
    number = home_number
    if block[0] != home[0] or block[1] != home[1] or block[2] != home[2]:
        number = find_block(field.keys, field.numbers, block)
    if number < 0:
        return -1
    voxel = number * _VOXELS + (point[2] & 7) * 64 + (point[1] & 7) * 8 + (point[0] & 7)
    if weight_of(field.voxels, voxel) > field.min_weight:
        return voxel
    return -1


@wp.func
def gradient(field: Field, home: wp.vec3i, home_number: int, point: wp.vec3i, distance: float) -> wp.vec3:
    """Return the gradient of the average distance at a voxel whose own is ``distance``, in truncations per voxel."""
    slope = wp.vec3()
    for axis in range(3):
        step = step_along(axis)
        after = seen_voxel(field, home, home_number, point + step)
        before = seen_voxel(field, home, home_number, point - step)
        width = float(0.0)
        rise = float(0.0)
        if after >= 0:
            rise += distance_of(field.voxels, after) - distance
            width += 1.0
        if before >= 0:
            rise += distance - distance_of(field.voxels, before)
            width += 1.0
        if width > 0.0:
            slope[axis] = rise / width
    return slope


@wp.kernel
def _emit_normals(
    first: int,
    shares: int,
    blocks: wp.array(dtype=wp.vec3i),
    cells: Cells,
    field: Field,
    normals: wp.array(dtype=wp.vec3),
) -> None:
    index = wp.tid() + first
    layer = index / shares
    if cells.starts[layer][0] == cells.starts[layer + 1][0]:
        return
    number = number_of(cells, layer >> 3)
    block = blocks[number]
    for axis in range(3):
        step = step_along(axis)
        left = cells.edges[layer, axis] & share_of(index - layer * shares, shares)
        vertex = vertex_number(cells, layer, axis, lowest_bit(left))
        while left != NONE:
            bit = lowest_bit(left)
            start = 8 * block + wp.vec3i(bit & 7, bit >> 3, layer & 7)
            a = distance_of(field.voxels, seen_voxel(field, block, number, start))
            b = distance_of(field.voxels, seen_voxel(field, block, number, start + step))
            along = a / (a - b)
            slope_a = gradient(field, block, number, start, a)
            slope_b = gradient(field, block, number, start + step, b)
            normal = wp.normalize((1.0 - along) * slope_a + along * slope_b)
            if wp.length_sq(normal) == 0.0:
                # The field is as flat as it gets; along its edge at least it rises outwards.
                normal[axis] = wp.sign(b - a)
            normals[vertex] = normal
            vertex += 1
            left = left & (left - wp.uint64(1))


def vertex_normals(volume: Volume, cells: Cells, *, vertices: int, min_weight: float) -> wp.array:
    """Return the unit normals (vertices,) of a surface's vertices on the device, towards positive distances."""
    field = Field()
    field.keys, field.numbers, field.voxels = volume.table.keys, volume.table.numbers, volume.voxels
    field.min_weight = min_weight
    normals = wp.empty(vertices, dtype=wp.vec3, device=volume.device)
    shares = shares_on(volume.device)
    launch_in_slabs(
        _emit_normals,
        dim=shares * (len(cells.starts) - 1),
        inputs=[shares, volume.table.blocks, cells, field],
        outputs=[normals],
        device=volume.device,
    )
    return normals
