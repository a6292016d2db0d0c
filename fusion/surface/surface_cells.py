"""Which cells and blocks of a volume a ray has to look into: those that hold surface, as marching cubes has it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from fusion.devices import launch_in_slabs
from fusion.surface.cells import find_cells
from fusion.surface.layers import NONE
from fusion.volume.tsdf_volume import Volume

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@dataclass(frozen=True, kw_only=True)
class SurfaceCells:
    """The cells that hold surface, for n blocks; bit 8·y + x of a layer is the cell at (x, y) in it.

    ``layers`` (8 n,) uint64, eight layers a block from z = 0 on; ``neighbours`` (n, 8) the numbers of the blocks at
    (dx, dy, dz), by dx + 2·dy + 4·dz, −1 where there is none; ``numbers`` (capacity,) the block table's numbers by
    slot, −1 also for blocks without surface. ``bounds`` are the least and the greatest coordinates of blocks with
    surface, None where there are none.
    """

    layers: wp.array
    neighbours: wp.array
    numbers: wp.array
    bounds: tuple[Any, Any] | None


@wp.kernel
def _number_surface_blocks(
    first: int,
    numbers: wp.array(dtype=int),
    layers: wp.array(dtype=wp.uint64),
    surface_numbers: wp.array(dtype=int),
) -> None:
    slot = wp.tid() + first
    number = numbers[slot]
    surface_numbers[slot] = -1
    if number >= 0:
        found = wp.uint64(0)
        for z in range(8):
            found |= layers[8 * number + z]
        if found != NONE:
            surface_numbers[slot] = number


def find_surface_cells(volume: Volume, *, min_weight: float = 0.0) -> SurfaceCells:
    """Find the cells of a volume that hold surface; a voxel was seen where its weight is over ``min_weight``."""
    device, table = volume.device, volume.table
    # No sign pattern has triangles: none are wanted.
    no_triangles = wp.zeros(256, dtype=int, device=device)
    cells = find_cells(volume, no_triangles, meshed=None, min_weight=min_weight)
    numbers = wp.empty(table.capacity, dtype=int, device=device)
    launch_in_slabs(
        _number_surface_blocks,
        dim=table.capacity,
        inputs=[table.numbers, cells.active],
        outputs=[numbers],
        device=device,
    )
    found = numbers.numpy()
    with_surface = table.blocks.numpy()[found[found >= 0]]
    bounds = None
    if len(with_surface):
        bounds = wp.vec3i(*np.min(with_surface, axis=0).tolist()), wp.vec3i(*np.max(with_surface, axis=0).tolist())
    return SurfaceCells(layers=cells.active, neighbours=cells.upper, numbers=numbers, bounds=bounds)
