"""The cells of the sparse grid: between which voxels the surface passes, and which voxel edges carry a vertex.

A cell's corners are eight neighbouring voxels, of up to eight blocks; it belongs to the block of its lowest corner. It
has a surface only where all of them were observed, so unseen space never makes any. Vertices lie on voxel edges, belong
to the block of the edge's lower voxel, and are shared by the cells around them.

A voxel is read once, into two bits; all else is found from the words that these make up (``fusion.surface.layers``).
"""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from datagen.errors import InputError
from fusion.devices import sum_before
from fusion.surface.layers import (
    NONE,
    Cells,
    case_of,
    corners_back,
    corners_on,
    is_wanted,
    launch_over_layers,
    lowest_bit,
    number_of,
    slot_of,
)
from fusion.volume.block_table import BLOCK_SIDE, BLOCK_VOXELS, BlockTable, find_block
from fusion.volume.tsdf_volume import Volume
from fusion.volume.voxels import Voxels

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_VOXELS = wp.constant(BLOCK_VOXELS)
_CUDA_LANES = 32

# One thread a layer on the CPU, where the plain loop becomes vector instructions; a warp a layer on CUDA, where its
# lanes read 32 voxels side by side and vote.
_STATES_IN_CPP = """
    union { float f; unsigned int u; } as;
    as.f = min_weight;
    // Packed weights ascend with their bits, so these are compared and not unpacked.
    const unsigned int none = 112u << 23;
    const unsigned int weight_bits = as.u > none ? (as.u - none) >> 12 : 0u;
    const bool packed = voxels.packed.shape[0] > 0;
    const unsigned long long *bits = packed ? (const unsigned long long *)voxels.packed.data + first_voxel : nullptr;
    const float *distance = packed ? nullptr : voxels.distance_sum.data + first_voxel;
    const float *weight = packed ? nullptr : voxels.weight.data + first_voxel;
    unsigned long long seen_word = 0, inside_word = 0;
#ifdef __CUDA_ARCH__
    for (int half = 0; half < 64; half += 32) {
        const int i = half + lane;
        const unsigned long long voxel = packed ? bits[i] : 0ull;
        const bool seen = packed ? ((unsigned int)(voxel >> 16) & 0xffffu) > weight_bits : weight[i] > min_weight;
        const bool inside = seen && (packed ? ((voxel >> 15) & 1ull) != 0ull : distance[i] < 0.0f);
        seen_word |= (unsigned long long)__ballot_sync(0xffffffffu, seen) << half;
        inside_word |= (unsigned long long)__ballot_sync(0xffffffffu, inside) << half;
    }
    if (lane != 0) return;
#else
    if (packed) {
        for (int i = 0; i < 64; ++i) {
            const unsigned long long seen = ((bits[i] >> 16) & 0xffffull) > weight_bits ? 1ull : 0ull;
            seen_word |= seen << i;
            inside_word |= (seen & (bits[i] >> 15)) << i;
        }
    } else {
        for (int i = 0; i < 64; ++i) {
            const unsigned long long seen = weight[i] > min_weight ? 1ull : 0ull;
            seen_word |= seen << i;
            inside_word |= (distance[i] < 0.0f ? seen : 0ull) << i;
        }
    }
#endif
    cells.seen.data[layer] = seen_word;
    cells.inside.data[layer] = inside_word;
"""


@wp.func_native(_STATES_IN_CPP)
def find_states(voxels: Voxels, first_voxel: int, lane: int, min_weight: float, layer: int, cells: Cells) -> None:
    """Find which voxels of a layer, from index ``first_voxel`` on, were seen, and which of these are inside."""


@wp.kernel
def _find_neighbours(
    first: int,
    blocks: wp.array(dtype=wp.vec3i),
    keys: wp.array(dtype=wp.int64),
    numbers: wp.array(dtype=int),
    cells: Cells,
) -> None:
    index = wp.tid() + first
    slot = index >> 3
    corner = index & 7
    beyond = slot
    if corner > 0:
        step = wp.vec3i(corner & 1, (corner >> 1) & 1, corner >> 2)
        beyond = slot_of(cells, find_block(keys, numbers, blocks[number_of(cells, slot)] + step))
    cells.upper[slot, corner] = beyond
    if beyond >= 0:
        cells.lower[beyond, corner] = slot  # no other thread comes to this place


@wp.kernel
def _group_neighbours(first: int, cells: Cells) -> None:
    index = wp.tid() + first
    slot = index >> 3
    corner = index & 7
    own = slot & 7
    cells.upper[slot, corner] = wp.where((own & corner) == 0, slot + corner, -1)
    cells.lower[slot, corner] = wp.where((own & corner) == corner, slot - corner, -1)


@wp.kernel
def _find_states(first: int, lanes: int, apart: bool, voxels: Voxels, min_weight: float, cells: Cells) -> None:
    index = wp.tid() + first
    layer = index / lanes
    slot = layer >> 3
    z = layer & 7
    number = number_of(cells, slot)
    if apart and (slot & 4) != 0 and z > 0:
        number = -1  # of the blocks above, a group needs the lowest layer
    if number < 0:
        cells.seen[layer] = NONE
        cells.inside[layer] = NONE
    else:
        find_states(voxels, number * _VOXELS + z * 64, index - layer * lanes, min_weight, layer, cells)


@wp.kernel
def _find_active_cells(first: int, cells: Cells) -> None:
    layer = wp.tid() + first
    slot = layer >> 3
    z = layer & 7
    cells.active[layer] = NONE
    if cells.seen[layer] == NONE:
        return
    if not is_wanted(cells, slot):
        return
    below = corners_on(cells.inside, cells.upper, slot, z)
    above = corners_on(cells.inside, cells.upper, slot, z + 1)
    some = below[0] | below[1] | below[2] | below[3] | above[0] | above[1] | above[2] | above[3]
    every = below[0] & below[1] & below[2] & below[3] & above[0] & above[1] & above[2] & above[3]
    if (some & ~every) == NONE:
        return
    seen_below = corners_on(cells.seen, cells.upper, slot, z)
    seen_above = corners_on(cells.seen, cells.upper, slot, z + 1)
    seen = seen_below[0] & seen_below[1] & seen_below[2] & seen_below[3]
    seen = seen & seen_above[0] & seen_above[1] & seen_above[2] & seen_above[3]
    cells.active[layer] = some & ~every & seen


@wp.kernel
def _find_edges(first: int, triangle_counts: wp.array(dtype=int), cells: Cells) -> None:
    layer = wp.tid() + first
    slot = layer >> 3
    z = layer & 7
    active = corners_back(cells.active, cells.lower, slot, z)
    under = corners_back(cells.active, cells.lower, slot, z - 1)
    around = wp.vec3ul(
        active[0] | active[2] | under[0] | under[2],
        active[0] | active[1] | under[0] | under[1],
        active[0] | active[1] | active[2] | active[3],
    )
    vertices = int(0)
    triangles = int(0)
    if (around[0] | around[1] | around[2]) != NONE:
        below = corners_on(cells.inside, cells.upper, slot, z)
        above = corners_on(cells.inside, cells.upper, slot, z + 1)
        # Both ends of an edge of an active cell were seen.
        edges = wp.vec3ul(
            (below[0] ^ below[1]) & around[0], (below[0] ^ below[2]) & around[1], (below[0] ^ above[0]) & around[2]
        )
        for axis in range(3):
            cells.edges[layer, axis] = edges[axis]
            vertices += wp.bit_count(edges[axis])
        left = active[0]
        while left != NONE:
            triangles += triangle_counts[case_of(below, above, lowest_bit(left))]
            left = left & (left - wp.uint64(1))
    # Where there are none the edges' words stay as they are: nothing reads them.
    cells.starts[layer] = wp.vec2i(vertices, triangles)


@wp.kernel
def _list_around(
    listed: wp.array(dtype=int),
    blocks: wp.array(dtype=wp.vec3i),
    keys: wp.array(dtype=wp.int64),
    numbers: wp.array(dtype=int),
    first_step: int,
    side: int,
    around: wp.array2d(dtype=int),
) -> None:
    index, step = wp.tid()
    offset = wp.vec3i(step % side, (step / side) % side, step / (side * side)) + wp.vec3i(first_step)
    around[index, step] = find_block(keys, numbers, blocks[listed[index]] + offset)


def block_numbers(volume: Volume, blocks: ArrayLike) -> NDArray[np.int32]:
    """Return block numbers (n,) ascending and without repetition; raises InputError where there is no such block."""
    numbers = np.unique(np.asarray(blocks, dtype=np.int64).reshape(-1))
    if len(numbers) and not (numbers[0] >= 0 and numbers[-1] < volume.table.count):
        raise InputError(f"block {numbers[[0, -1]].tolist()}: the volume has {volume.table.count} blocks, from 0 on")
    return numbers.astype(np.int32)


def blocks_around(table: BlockTable, numbers: NDArray[np.int32], *, steps: range) -> NDArray[np.int32]:
    """Return the numbers of the existing blocks that lie ``steps`` along each axis from any of ``numbers``, ascending.

    The steps are successive block coordinates; 0 is the block itself.
    """
    found = np.unique(_around(table, numbers, steps).numpy())
    return found[found >= 0]


def _around(table: BlockTable, numbers: NDArray[np.int32], steps: range) -> wp.array:
    """Return for each block the numbers of those around it (n, steps³) on the device, x fastest; −1 for none."""
    listed = wp.array(numbers, dtype=int, device=table.device)
    around = wp.empty((len(numbers), len(steps) ** 3), dtype=int, device=table.device)
    inputs = [listed, table.blocks, table.keys, table.numbers, steps[0], len(steps)]
    wp.launch(_list_around, dim=around.shape, inputs=inputs, outputs=[around], device=table.device)
    return around


def _cells(numbers: wp.array, wanted: NDArray[np.uint8], *, slots: int) -> Cells:
    """Return room for what is found in ``slots`` blocks."""
    device, layers = numbers.device, BLOCK_SIDE * slots
    cells = Cells()
    cells.numbers = numbers
    cells.wanted = wp.array(wanted, dtype=wp.uint8, device=device)
    cells.upper = wp.empty((slots, 8), dtype=int, device=device)
    cells.lower = wp.full((slots, 8), -1, dtype=int, device=device)
    cells.inside = wp.empty(layers, dtype=wp.uint64, device=device)
    cells.seen = wp.empty(layers, dtype=wp.uint64, device=device)
    cells.active = wp.empty(layers, dtype=wp.uint64, device=device)
    cells.edges = wp.empty((layers, 3), dtype=wp.uint64, device=device)
    cells.starts = wp.zeros(layers + 1, dtype=wp.vec2i, device=device)
    return cells


def _slots(volume: Volume, meshed: NDArray[np.int32] | None, *, apart: bool) -> Cells:
    """Return cells with a slot for each block that is meshed or holds some of the corners."""
    table = volume.table
    if meshed is None:
        return _cells(wp.empty(0, dtype=int, device=volume.device), np.zeros(0, np.uint8), slots=table.count)
    if apart:
        numbers = _around(table, meshed, range(2)).flatten()
        return _cells(numbers, (np.arange(8 * len(meshed)) % 8 == 0).astype(np.uint8), slots=8 * len(meshed))
    listed = blocks_around(table, meshed, steps=range(2))
    wanted = np.isin(listed, meshed).astype(np.uint8)
    return _cells(wp.array(listed, dtype=int, device=volume.device), wanted, slots=len(listed))


def find_cells(
    volume: Volume,
    triangle_counts: wp.array,
    *,
    meshed: NDArray[np.int32] | None,
    apart: bool = False,
    min_weight: float,
) -> Cells:
    """Find the cells of the ``meshed`` blocks (all where None) that the surface passes through, and their edges.

    ``triangle_counts`` (256,) are those of the sign patterns. A voxel was seen where its weight is over ``min_weight``.
    Blocks meshed ``apart`` share no vertices: each has a group of eight slots to itself, for the blocks at its corners.
    """
    device, table = volume.device, volume.table
    assert not apart or meshed is not None, "blocks that are meshed apart are listed"
    cells = _slots(volume, meshed, apart=apart)
    layers = len(cells.inside)
    lanes = _CUDA_LANES if device.is_cuda else 1

    def launch(kernel: wp.Kernel, dim: int, inputs: list[Any]) -> None:
        launch_over_layers(kernel, dim=dim, inputs=inputs, outputs=[cells], device=device)

    if apart:
        launch(_group_neighbours, layers, [])
    else:
        launch(_find_neighbours, layers, [table.blocks, table.keys, table.numbers])
    launch(_find_states, lanes * layers, [lanes, apart, volume.voxels, min_weight])
    find_crossings(cells, triangle_counts)
    return cells


def find_crossings(cells: Cells, triangle_counts: wp.array) -> None:
    """Find the active cells and the crossed edges (``cells.active``, ``edges``, ``starts``) from what is inside."""
    device, layers = cells.inside.device, len(cells.inside)
    launch_over_layers(_find_active_cells, dim=layers, inputs=[], outputs=[cells], device=device)
    launch_over_layers(_find_edges, dim=layers, inputs=[triangle_counts], outputs=[cells], device=device)
    cells.starts[layers:].zero_()
    sum_before(cells.starts)
