"""What is true of a block's voxels, a layer to a 64-bit word, and how words are shifted across the blocks' borders.

A layer is the 8×8 voxels of a block at one z; voxel (x, y) is at bit 8·y + x. So the cells and edges of a layer are
found together by a few operations on words, and a vertex's number by counting bits.
"""

from typing import Any

import warp as wp

from fusion.devices import Device, launch_in_slabs
from fusion.volume.block_table import BLOCK_SIDE, BLOCK_VOXELS

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_VOXELS = wp.constant(BLOCK_VOXELS)
_ALL = wp.constant(wp.uint64(0xFFFFFFFFFFFFFFFF))
_FEW_LAYERS = 2048
NONE = wp.constant(wp.uint64(0))
"""The word of no voxels."""
_ONE = wp.constant(wp.uint64(1))
_X_0 = wp.constant(wp.uint64(0x0101010101010101))
_X_0_TO_6 = wp.constant(wp.uint64(0x7F7F7F7F7F7F7F7F))
_X_1_TO_7 = wp.constant(wp.uint64(0xFEFEFEFEFEFEFEFE))
_SEVEN = wp.constant(wp.uint64(7))
_EIGHT = wp.constant(wp.uint64(8))
_LAST_ROW = wp.constant(wp.uint64(56))


@wp.struct
class Cells:
    """Where the surface passes in m blocks, which have slots 0 … m−1.

    ``numbers`` (m,) the blocks' numbers, −1 for none, and ``wanted`` (m,) 1 for blocks whose cells are meshed, 0 for
    those that only hold some of the corners; both empty where all blocks are meshed, each in the slot of its number.
    ``upper`` and ``lower`` (m, 8) the slots of the blocks around: bit i of the column is set where it is one block on
    along axis i, or one back; −1 where there is none. The numbers ascend, unless each meshed block has a group of eight
    slots to itself.

    By layers, 8·slot + z: ``inside``, ``seen``, ``active`` (8 m,) the voxels that are inside the surface, those that
    were seen, and those whose cell the surface passes through; ``edges`` (8 m, 3) the voxels whose edge along an axis
    carries a vertex; ``starts`` (8 m + 1,) how many vertices and triangles come before.
    """

    numbers: wp.array(dtype=int)
    wanted: wp.array(dtype=wp.uint8)
    upper: wp.array2d(dtype=int)
    lower: wp.array2d(dtype=int)
    inside: wp.array(dtype=wp.uint64)
    seen: wp.array(dtype=wp.uint64)
    active: wp.array(dtype=wp.uint64)
    edges: wp.array2d(dtype=wp.uint64)
    starts: wp.array(dtype=wp.vec2i)


@wp.func
def number_of(cells: Cells, slot: int) -> int:
    """Return the number of the block in a slot."""
    if cells.numbers.shape[0] > 0:
        return cells.numbers[slot]
    return slot


@wp.func
def slot_of(cells: Cells, number: int) -> int:
    """Return the slot of a block, −1 where it has none; the numbers ascend."""
    if cells.numbers.shape[0] == 0:
        return number
    low = int(0)
    high = cells.numbers.shape[0]
    while low < high:
        middle = (low + high) / 2
        if cells.numbers[middle] < number:
            low = middle + 1
        else:
            high = middle
    if low == cells.numbers.shape[0]:
        return -1
    if cells.numbers[low] != number:
        return -1
    return low


@wp.func
def is_wanted(cells: Cells, slot: int) -> bool:
    """Return whether a slot's cells are meshed."""
    if cells.wanted.shape[0] == 0:
        return True
    return cells.wanted[slot] != wp.uint8(0)


@wp.func
def lowest_bit(word: wp.uint64) -> int:
    """Return the index of the lowest bit that is set, 64 where none is."""
    return wp.bit_count((word - _ONE) & ~word)


@wp.func
def below(bit: int) -> wp.uint64:
    """Return the word of all bits before one."""
    return (_ONE << wp.uint64(bit)) - _ONE


@wp.func
def one_on_in_x(word: wp.uint64, beyond: wp.uint64) -> wp.uint64:
    """Return at each voxel what is true of the next along x, given the same layer of the block beyond."""
    return ((word >> _ONE) & _X_0_TO_6) | ((beyond & _X_0) << _SEVEN)


@wp.func
def one_on_in_y(word: wp.uint64, beyond: wp.uint64) -> wp.uint64:
    """Return at each voxel what is true of the next along y."""
    return (word >> _EIGHT) | (beyond << _LAST_ROW)


@wp.func
def one_back_in_x(word: wp.uint64, beyond: wp.uint64) -> wp.uint64:
    """Return at each voxel what is true of the one before it along x."""
    return ((word << _ONE) & _X_1_TO_7) | ((beyond >> _SEVEN) & _X_0)


@wp.func
def one_back_in_y(word: wp.uint64, beyond: wp.uint64) -> wp.uint64:
    """Return at each voxel what is true of the one before it along y."""
    return (word << _EIGHT) | (beyond >> _LAST_ROW)


@wp.func
def word_at(
    words: wp.array(dtype=wp.uint64), slots: wp.array2d(dtype=int), slot: int, corner: int, z: int
) -> wp.uint64:
    """Return the word of the block at ``corner`` from a slot, 0 where there is no such block."""
    holder = slots[slot, corner]
    if holder < 0:
        return NONE
    return words[8 * holder + z]


@wp.func
def corners_on(words: wp.array(dtype=wp.uint64), upper: wp.array2d(dtype=int), slot: int, z: int) -> wp.vec4ul:
    """Return at each voxel what is true of itself, of the next along x, along y, and along both; z from 0 to 8."""
    above = (z >> 3) << 2
    own = word_at(words, upper, slot, above, z & 7)
    x = word_at(words, upper, slot, above + 1, z & 7)
    y = word_at(words, upper, slot, above + 2, z & 7)
    xy = word_at(words, upper, slot, above + 3, z & 7)
    on_x = one_on_in_x(own, x)
    return wp.vec4ul(own, on_x, one_on_in_y(own, y), one_on_in_y(on_x, one_on_in_x(y, xy)))


@wp.func
def corners_back(words: wp.array(dtype=wp.uint64), lower: wp.array2d(dtype=int), slot: int, z: int) -> wp.vec4ul:
    """Return at each voxel what is true of itself, of the one before along x, along y, and along both; z from −1 on."""
    under = wp.where(z < 0, 4, 0)
    own = word_at(words, lower, slot, under, z & 7)
    x = word_at(words, lower, slot, under + 1, z & 7)
    y = word_at(words, lower, slot, under + 2, z & 7)
    xy = word_at(words, lower, slot, under + 3, z & 7)
    back_x = one_back_in_x(own, x)
    return wp.vec4ul(own, back_x, one_back_in_y(own, y), one_back_in_y(back_x, one_back_in_x(y, xy)))


@wp.func
def case_of(low: wp.vec4ul, high: wp.vec4ul, bit: int) -> int:
    """Return the sign pattern of a cell, from the layers of its corners below and above."""
    case = int(0)
    for corner in range(4):
        case |= int((low[corner] >> wp.uint64(bit)) & _ONE) << corner
        case |= int((high[corner] >> wp.uint64(bit)) & _ONE) << (corner + 4)
    return case


@wp.func
def step_along(axis: int) -> wp.vec3i:
    """Return the unit step along an axis."""
    return wp.vec3i(int(axis == 0), int(axis == 1), int(axis == 2))


@wp.func
def share_of(part: int, shares: int) -> wp.uint64:
    """Return the word of the voxels in one of equal ``shares`` of a layer."""
    if shares == 1:
        return _ALL
    bits = 64 / shares
    return below(bits) << wp.uint64(part * bits)


@wp.func
def voxel_of(cells: Cells, slot: int, x: int, y: int, z: int) -> int:
    """Return the index of the voxel at (x, y, z), each from 0 to 8, seen from a slot."""
    holder = cells.upper[slot, (x >> 3) | ((y >> 3) << 1) | ((z >> 3) << 2)]
    return number_of(cells, holder) * _VOXELS + (z & 7) * 64 + (y & 7) * 8 + (x & 7)


@wp.func
def vertex_number(cells: Cells, layer: int, axis: int, bit: int) -> int:
    """Return the number of the vertex on the edge along ``axis`` from a layer's voxel."""
    number = cells.starts[layer][0] + wp.bit_count(cells.edges[layer, axis] & below(bit))
    for before in range(axis):
        number += wp.bit_count(cells.edges[layer, before])
    return number


def shares_on(device: Device) -> int:
    """Return into how many equal shares a layer's voxels are divided among threads: rows on CUDA, none on the CPU."""
    return BLOCK_SIDE if device.is_cuda else 1


def launch_over_layers(kernel: Any, *, dim: int, inputs: list[Any], outputs: list[Any], device: Device) -> None:
    """Launch a kernel with few operations a layer as ``launch_in_slabs`` does; few layers in one slab.

    Handing slabs to the cores takes as long as some thousand layers do, and live a frame changes fewer.
    """
    launch_in_slabs(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device, least_slab=_FEW_LAYERS)
