"""Which cells of the grid the surface passes through, one bit a cell.

A cell's corners are eight neighbouring voxels, of up to eight blocks; it belongs to the block of its lowest corner. It
holds surface where all corners were seen and the distance changes sign among them: the cells of marching cubes. The bits
of 64 voxels, a layer of a block, are worked on at once.
"""

from dataclasses import dataclass
from typing import Any

import warp as wp

from fusion.block_table import find_block
from fusion.devices import launch_in_slabs
from fusion.volume import Volume
from fusion.voxels import Voxels, distance_of, weight_of

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_LOWEST_X = wp.constant(wp.uint64(0x0101010101010101))
_OTHER_X = wp.constant(wp.uint64(0x7F7F7F7F7F7F7F7F))


@dataclass(frozen=True, kw_only=True)
class SurfaceCells:
    """The cells that hold surface, for n blocks; bit 8·y + x of a layer is the cell at (x, y) in it.

    ``layers`` (8 n) uint64, eight layers a block from z = 0 on; ``neighbours`` (n, 8) the numbers of the blocks at
    (dx, dy, dz), by dx + 2·dy + 4·dz, −1 where there is none; ``numbers`` (capacity,) the block table's numbers by slot,
    −1 also for blocks without surface. ``bounds`` are the least and the greatest coordinates of blocks with surface, None
    where there are none.
    """

    layers: wp.array
    neighbours: wp.array
    numbers: wp.array
    bounds: tuple[Any, Any] | None


@wp.kernel
def _number_neighbours(
    first: int,
    blocks: wp.array(dtype=wp.vec3i),
    keys: wp.array(dtype=wp.int64),
    numbers: wp.array(dtype=int),
    neighbours: wp.array2d(dtype=int),
) -> None:
    number = wp.tid() + first
    for corner in range(8):
        step = wp.vec3i(corner & 1, (corner >> 1) & 1, corner >> 2)
        neighbours[number, corner] = find_block(keys, numbers, blocks[number] + step)


@wp.kernel
def _pack_signs(
    first: int,
    voxels: Voxels,
    min_weight: float,
    seen: wp.array(dtype=wp.uint64),
    inside: wp.array(dtype=wp.uint64),
) -> None:
    layer = wp.tid() + first
    seen_bits = wp.uint64(0)
    inside_bits = wp.uint64(0)
    for i in range(64):
        voxel = 64 * layer + i
        weight = weight_of(voxels, voxel)
        if weight > 0.0:
            if weight >= min_weight:
                bit = wp.uint64(1) << wp.uint64(i)
                seen_bits |= bit
                if distance_of(voxels, voxel) < 0.0:
                    inside_bits |= bit
    seen[layer] = seen_bits
    inside[layer] = inside_bits


@wp.func
def layer_of(layers: wp.array(dtype=wp.uint64), block: int, z: int) -> wp.uint64:
    """Return the bits of a block's layer, none where there is no block."""
    if block < 0:
        return wp.uint64(0)
    return layers[8 * block + z]


@wp.func
def next_along_x(layer: wp.uint64, beyond: wp.uint64) -> wp.uint64:
    """Return at each bit the one whose x is greater by 1; ``beyond`` is the layer of the block that follows."""
    return ((layer >> wp.uint64(1)) & _OTHER_X) | ((beyond & _LOWEST_X) << wp.uint64(7))


@wp.func
def next_along_y(layer: wp.uint64, beyond: wp.uint64) -> wp.uint64:
    """Return at each bit the one whose y is greater by 1."""
    return (layer >> wp.uint64(8)) | (beyond << wp.uint64(56))


@wp.func
def over_corners(
    layers: wp.array(dtype=wp.uint64), neighbours: wp.array2d(dtype=int), number: int, z: int
) -> tuple[wp.uint64, wp.uint64]:
    """Return for each cell's four corners at height z, 0 to 8, whether the bit is set in all, and whether in any."""
    above = 4 * (z >> 3)
    here = layer_of(layers, neighbours[number, above], z & 7)
    past_x = layer_of(layers, neighbours[number, above + 1], z & 7)
    past_y = layer_of(layers, neighbours[number, above + 2], z & 7)
    past_both = layer_of(layers, neighbours[number, above + 3], z & 7)
    along_x = next_along_x(here, past_x)
    along_y = next_along_y(here, past_y)
    along_both = next_along_y(along_x, next_along_x(past_y, past_both))
    return here & along_x & along_y & along_both, here | along_x | along_y | along_both


@wp.kernel
def _find_surface_cells(
    first: int,
    seen: wp.array(dtype=wp.uint64),
    inside: wp.array(dtype=wp.uint64),
    neighbours: wp.array2d(dtype=int),
    layers: wp.array(dtype=wp.uint64),
    has_surface: wp.array(dtype=wp.uint8),
) -> None:
    number = wp.tid() + first
    found = wp.uint64(0)
    for z in range(8):
        all_seen_below, _any_seen_below = over_corners(seen, neighbours, number, z)
        all_seen_above, _any_seen_above = over_corners(seen, neighbours, number, z + 1)
        all_inside_below, any_inside_below = over_corners(inside, neighbours, number, z)
        all_inside_above, any_inside_above = over_corners(inside, neighbours, number, z + 1)
        changes = (any_inside_below | any_inside_above) & ~(all_inside_below & all_inside_above)
        layer = all_seen_below & all_seen_above & changes
        layers[8 * number + z] = layer
        found |= layer
    has_surface[number] = wp.where(found != wp.uint64(0), wp.uint8(1), wp.uint8(0))


@wp.kernel
def _number_surface_blocks(
    first: int,
    numbers: wp.array(dtype=int),
    has_surface: wp.array(dtype=wp.uint8),
    surface_numbers: wp.array(dtype=int),
) -> None:
    slot = wp.tid() + first
    number = numbers[slot]
    if number >= 0:
        if has_surface[number] == wp.uint8(0):
            number = -1
    surface_numbers[slot] = number


def find_surface_cells(volume: Volume, *, min_weight: float = 0.0) -> SurfaceCells:
    """Find the cells of a volume that hold surface; voxels of less weight than ``min_weight`` count as unseen."""
    device, table = volume.device, volume.table
    blocks = table.count
    neighbours = wp.empty((blocks, 8), dtype=int, device=device)
    seen, inside, layers = (wp.empty(8 * blocks, dtype=wp.uint64, device=device) for _ in range(3))
    has_surface = wp.empty(blocks, dtype=wp.uint8, device=device)
    numbers = wp.empty(table.capacity, dtype=int, device=device)
    launch_in_slabs(
        _number_neighbours,
        dim=blocks,
        inputs=[table.blocks, table.keys, table.numbers],
        outputs=[neighbours],
        device=device,
    )
    launch_in_slabs(
        _pack_signs, dim=8 * blocks, inputs=[volume.voxels, min_weight], outputs=[seen, inside], device=device
    )
    launch_in_slabs(
        _find_surface_cells,
        dim=blocks,
        inputs=[seen, inside, neighbours],
        outputs=[layers, has_surface],
        device=device,
    )
    launch_in_slabs(
        _number_surface_blocks,
        dim=table.capacity,
        inputs=[table.numbers, has_surface],
        outputs=[numbers],
        device=device,
    )
    with_surface = table.blocks.numpy()[:blocks][has_surface.numpy() > 0]
    bounds = None
    if len(with_surface):
        bounds = wp.vec3i(*with_surface.min(axis=0).tolist()), wp.vec3i(*with_surface.max(axis=0).tolist())
    return SurfaceCells(layers=layers, neighbours=neighbours, numbers=numbers, bounds=bounds)
