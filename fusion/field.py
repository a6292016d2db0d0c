"""The volume's distance as a continuous field: trilinear between voxel centres, +1 where unseen."""

import warp as wp

from fusion.block_table import BLOCK_SIDE, BLOCK_VOXELS, find_block
from fusion.volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_VOXELS = wp.constant(BLOCK_VOXELS)
_SHIFT = wp.constant(BLOCK_SIDE.bit_length() - 1)
_MASK = wp.constant(BLOCK_SIDE - 1)


@wp.struct
class Field:
    """What a kernel needs to read a volume; ``voxel_size`` in metres."""

    keys: wp.array(dtype=wp.int64)
    numbers: wp.array(dtype=int)
    distance_sum: wp.array(dtype=float)
    weight: wp.array(dtype=float)
    voxel_size: float


def field_of(volume: Volume) -> Field:
    """Return a volume's field, to be passed to kernels on its device."""
    field = Field()
    field.keys = volume.table.keys
    field.numbers = volume.table.numbers
    field.distance_sum = volume.distance_sum
    field.weight = volume.weight
    field.voxel_size = volume.voxel_size
    return field


@wp.func
def voxel_distance(field: Field, number: int, x: int, y: int, z: int) -> float:
    """Return the average t_d of the voxel with lattice coordinates (x, y, z), in block ``number``; +1 where unseen."""
    if number < 0:
        return 1.0
    voxel = number * _VOXELS + (z & _MASK) * 64 + (y & _MASK) * 8 + (x & _MASK)
    weight = field.weight[voxel]
    if weight == 0.0:
        return 1.0
    return field.distance_sum[voxel] / weight


@wp.func
def sample_distance(field: Field, point: wp.vec3) -> float:
    """Return t_d at a world point (metres), by trilinear interpolation between the eight voxel centres around it."""
    position = point / field.voxel_size
    x = int(wp.floor(position[0]))
    y = int(wp.floor(position[1]))
    z = int(wp.floor(position[2]))
    fx = position[0] - float(x)
    fy = position[1] - float(y)
    fz = position[2] - float(z)
    home = wp.vec3i(x >> _SHIFT, y >> _SHIFT, z >> _SHIFT)
    home_number = find_block(field.keys, field.numbers, home)
    total = float(0.0)
    for corner in range(8):
        dx = corner & 1
        dy = (corner >> 1) & 1
        dz = corner >> 2
        block = wp.vec3i((x + dx) >> _SHIFT, (y + dy) >> _SHIFT, (z + dz) >> _SHIFT)
        number = home_number
        if block != home:
            number = find_block(field.keys, field.numbers, block)
        share_x = wp.where(dx == 1, fx, 1.0 - fx)
        share_y = wp.where(dy == 1, fy, 1.0 - fy)
        share_z = wp.where(dz == 1, fz, 1.0 - fz)
        total += share_x * share_y * share_z * voxel_distance(field, number, x + dx, y + dy, z + dz)
    return total
