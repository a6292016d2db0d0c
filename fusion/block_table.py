"""Which 8×8×8 voxel blocks exist: an open-addressing hash from block coordinates to block numbers.

Block b holds the voxels 8·b … 8·b + 7; voxel i's centre lies at i · voxel_size in the world. The table only ever grows:
a block that was found is never lost, and its number never changes.
"""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.errors import InputError
from fusion.devices import Device

wp.set_module_options({"enable_backward": False})

BLOCK_SIDE = 8
BLOCK_VOXELS = BLOCK_SIDE**3
COORDINATE_LIMIT = 1 << 20
"""Block coordinates lie in [−COORDINATE_LIMIT, COORDINATE_LIMIT): three of them are packed into one 64-bit key."""

_EMPTY = wp.constant(wp.int64(-1))
_LIMIT = wp.constant(COORDINATE_LIMIT)
_COORDINATE_BITS = 21
_FIELD_BITS = wp.constant(wp.int64(_COORDINATE_BITS))
_FIELD_MASK = wp.constant(wp.int64((1 << _COORDINATE_BITS) - 1))


class BlockLimitError(InputError):
    """More blocks were asked for than the volume may hold."""


@wp.func
def block_key(block: wp.vec3i) -> wp.int64:
    """Pack block coordinates into one key; −1 where they are out of range."""
    x = block[0] + _LIMIT
    y = block[1] + _LIMIT
    z = block[2] + _LIMIT
    if wp.min(wp.min(x, y), z) < 0 or wp.max(wp.max(x, y), z) >= 2 * _LIMIT:
        return _EMPTY
    return (((wp.int64(x) << _FIELD_BITS) | wp.int64(y)) << _FIELD_BITS) | wp.int64(z)


@wp.func
def block_of_key(key: wp.int64) -> wp.vec3i:
    """Unpack a key into block coordinates."""
    x = wp.int32(key >> (_FIELD_BITS + _FIELD_BITS)) - _LIMIT
    y = wp.int32((key >> _FIELD_BITS) & _FIELD_MASK) - _LIMIT
    z = wp.int32(key & _FIELD_MASK) - _LIMIT
    return wp.vec3i(x, y, z)


@wp.func
def first_slot(key: wp.int64, capacity: int) -> int:
    """Return where a key's probe begins (Fibonacci hashing); capacity is a power of two."""
    mixed = wp.uint64(key) * wp.uint64(0x9E3779B97F4A7C15)
    return wp.int32(mixed >> wp.uint64(33)) & (capacity - 1)


@wp.func
def insert_key(keys: wp.array(dtype=wp.int64), key: wp.int64, key_count: wp.array(dtype=int)) -> bool:
    """Enter ``key`` unless it is there; False where the table is half full and has to grow first."""
    capacity = keys.shape[0]
    slot = first_slot(key, capacity)
    # Each slot is read once: another thread may fill it in between. Threads that find the table half full at the same
    # time may fill it further, so the search is bounded, and whoever claims a slot too many says so.
    for _probe in range(capacity):
        held = keys[slot]
        if held == _EMPTY:
            if key_count[0] >= capacity / 2:
                return False
            held = wp.atomic_cas(keys, slot, _EMPTY, key)
            if held == _EMPTY:
                return wp.atomic_add(key_count, 0, 1) < capacity / 2
        if held == key:
            return True
        slot = (slot + 1) & (capacity - 1)
    return False


@wp.func
def find_slot(keys: wp.array(dtype=wp.int64), key: wp.int64) -> int:
    """Return the slot that holds ``key``, or the empty one where its search ends."""
    capacity = keys.shape[0]
    slot = first_slot(key, capacity)
    while keys[slot] != key and keys[slot] != _EMPTY:
        slot = (slot + 1) & (capacity - 1)
    return slot


@wp.func
def find_block(keys: wp.array(dtype=wp.int64), numbers: wp.array(dtype=int), block: wp.vec3i) -> int:
    """Return the number of a block, −1 where it does not exist."""
    return numbers[find_slot(keys, block_key(block))]


@wp.kernel
def _list_new_keys(
    keys: wp.array(dtype=wp.int64),
    numbers: wp.array(dtype=int),
    new_keys: wp.array(dtype=wp.int64),
    new_count: wp.array(dtype=int),
) -> None:
    slot = wp.tid()
    if keys[slot] == _EMPTY:
        return
    if numbers[slot] < 0:
        new_keys[wp.atomic_add(new_count, 0, 1)] = keys[slot]


@wp.kernel
def _number_keys(
    new_keys: wp.array(dtype=wp.int64),
    first_number: int,
    keys: wp.array(dtype=wp.int64),
    numbers: wp.array(dtype=int),
    blocks: wp.array(dtype=wp.vec3i),
) -> None:
    index = wp.tid()
    key = new_keys[index]
    numbers[find_slot(keys, key)] = first_number + index
    blocks[first_number + index] = block_of_key(key)


@wp.kernel
def _insert_numbered(
    blocks: wp.array(dtype=wp.vec3i),
    keys: wp.array(dtype=wp.int64),
    numbers: wp.array(dtype=int),
    key_count: wp.array(dtype=int),
) -> None:
    key = block_key(blocks[wp.tid()])
    insert_key(keys, key, key_count)
    numbers[find_slot(keys, key)] = wp.tid()


class BlockTable:
    """The hash and the list of its blocks, on one device.

    ``keys`` and ``numbers`` (capacity,) are the hash; ``blocks`` (≥ count, 3) the block coordinates by number. At most
    half of the slots are ever in use. ``max_blocks`` bounds the count: growing past it raises BlockLimitError.
    """

    def __init__(self, *, device: Device, max_blocks: int, capacity: int = 1 << 14) -> None:
        self.device = device
        self.max_blocks = max_blocks
        self.count = 0
        self._allocate(capacity)
        self.blocks = wp.empty(capacity // 2, dtype=wp.vec3i, device=device)

    @property
    def capacity(self) -> int:
        """The number of slots."""
        return self.keys.shape[0]

    def _allocate(self, capacity: int) -> None:
        self.keys = wp.full(capacity, -1, dtype=wp.int64, device=self.device)
        self.numbers = wp.full(capacity, -1, dtype=int, device=self.device)
        self.key_count = wp.zeros(1, dtype=int, device=self.device)

    def grow(self) -> None:
        """Double the table, dropping keys that were inserted but not yet numbered; raises BlockLimitError."""
        if self.capacity // 2 >= 2 * self.max_blocks:
            raise BlockLimitError(f"the volume needs more than the {self.max_blocks:,} blocks that memory allows")
        known = self.blocks
        self._allocate(2 * self.capacity)
        self.blocks = wp.empty(self.capacity // 2, dtype=wp.vec3i, device=self.device)
        if self.count:
            wp.copy(self.blocks, known, count=self.count)
            inputs = [self.blocks, self.keys, self.numbers, self.key_count]
            wp.launch(_insert_numbered, dim=self.count, inputs=inputs, device=self.device)

    def number_new_blocks(self) -> None:
        """Give every inserted key that has none the next block number; raises BlockLimitError past the bound.

        They are numbered in Morton order: neighbours in space are neighbours in memory, and the numbers do not depend
        on which thread was first.
        """
        new_keys = wp.empty(self.capacity // 2, dtype=wp.int64, device=self.device)
        new_count = wp.zeros(1, dtype=int, device=self.device)
        inputs = [self.keys, self.numbers]
        wp.launch(_list_new_keys, dim=self.capacity, inputs=inputs, outputs=[new_keys, new_count], device=self.device)
        count = int(new_count.numpy()[0])
        if self.count + count > self.max_blocks:
            raise BlockLimitError(f"the volume needs more than the {self.max_blocks:,} blocks that memory allows")
        if count == 0:
            return
        in_order = wp.array(in_morton_order(new_keys[:count].numpy()), dtype=wp.int64, device=self.device)
        inputs = [in_order, self.count, self.keys]
        wp.launch(_number_keys, dim=count, inputs=inputs, outputs=[self.numbers, self.blocks], device=self.device)
        self.count += count

    def adopt(self, blocks: NDArray[np.int32]) -> None:
        """Fill an empty table with block coordinates (n, 3), all different, numbered in their order."""
        assert self.count == 0, "only an empty table adopts blocks"
        while len(blocks) > self.capacity // 2:
            self.grow()
        wp.copy(self.blocks, wp.array(blocks, dtype=wp.vec3i, device=self.device))
        self.count = len(blocks)
        inputs = [self.blocks, self.keys, self.numbers, self.key_count]
        wp.launch(_insert_numbered, dim=self.count, inputs=inputs, device=self.device)


def in_morton_order(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return block keys (n,) sorted so that blocks which are near in space are near in the list."""
    code = np.zeros(len(keys), dtype=np.uint64)
    bits = np.uint64(_COORDINATE_BITS)
    fields = keys.astype(np.uint64)
    for bit in range(_COORDINATE_BITS):
        for axis in range(3):
            field_bit = (fields >> (np.uint64(axis) * bits + np.uint64(bit))) & np.uint64(1)
            code |= field_bit << np.uint64(3 * bit + axis)
    return keys[np.argsort(code)]
