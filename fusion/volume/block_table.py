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


PRESENT, ENTERED, TABLE_FULL, OUT_OF_RANGE = 0, 1, 2, 3


class BlockLimitError(InputError):
    """More blocks were asked for than the volume may hold."""


@wp.struct
class BlockArrays:
    """What kernels see: the hash ``keys`` and ``numbers`` (capacity,), ``blocks`` by number, ``count`` (1,)."""

    keys: wp.array(dtype=wp.int64)
    numbers: wp.array(dtype=int)
    blocks: wp.array(dtype=wp.vec3i)
    count: wp.array(dtype=int)


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


# Warp's atomics are not atomic between threads of the CPU; these are, on every device.
_ATOMIC_IN_CPP = """
    auto claim_slot = [](auto &keys, int slot, long long key) -> long long {
        unsigned long long *held = (unsigned long long *)&keys.data[slot];
#ifdef __CUDA_ARCH__
        return (long long)atomicCAS(held, ~0ull, (unsigned long long)key);
#else
        return (long long)__sync_val_compare_and_swap(held, ~0ull, (unsigned long long)key);
#endif
    };
    auto count_up = [](auto &counts, int index) -> int {
#ifdef __CUDA_ARCH__
        return atomicAdd(&counts.data[index], 1);
#else
        return __sync_fetch_and_add(&counts.data[index], 1);
#endif
    };
"""


@wp.func_native(_ATOMIC_IN_CPP + "return claim_slot(keys, slot, key);")
def claim_slot(keys: wp.array(dtype=wp.int64), slot: int, key: wp.int64) -> wp.int64:
    """Put ``key`` into a slot if that is empty; returns what it held before."""


ENTER_IN_CPP = (
    _ATOMIC_IN_CPP
    + f"""
    constexpr int BLOCK_LIMIT = {COORDINATE_LIMIT}, KEY_BITS = {_COORDINATE_BITS};
    constexpr int PRESENT = {PRESENT}, ENTERED = {ENTERED}, TABLE_FULL = {TABLE_FULL}, OUT_OF_RANGE = {OUT_OF_RANGE};
"""
    + """
    auto enter_block = [&](int x, int y, int z) -> int {
        x += BLOCK_LIMIT; y += BLOCK_LIMIT; z += BLOCK_LIMIT;
        if ((x | y | z) < 0 || (x | y | z) >= 2 * BLOCK_LIMIT) return OUT_OF_RANGE;
        const long long empty = -1, key = ((long long)x << KEY_BITS | y) << KEY_BITS | z;
        const int capacity = table.keys.shape[0];
        int slot = (int)((unsigned long long)key * 0x9E3779B97F4A7C15ull >> 33) & (capacity - 1);
        // Each slot is read once: another thread may fill it in between. The search is bounded, since threads that find
        // the table half full at the same time may fill it further.
        for (int probe = 0; probe < capacity; ++probe, slot = (slot + 1) & (capacity - 1)) {
            long long held = table.keys.data[slot];
            if (held == empty) {
                if (table.count.data[0] >= capacity / 2) return TABLE_FULL;
                held = claim_slot(table.keys, slot, key);
                if (held == empty) {
                    const int number = count_up(table.count, 0);
                    if (number >= table.blocks.shape[0]) return TABLE_FULL;
                    table.numbers.data[slot] = number;
                    table.blocks.data[number] = wp::vec3i(x - BLOCK_LIMIT, y - BLOCK_LIMIT, z - BLOCK_LIMIT);
                    return ENTERED;
                }
            }
            if (held == key) return PRESENT;
        }
        return TABLE_FULL;
    };
"""
)
"""C++ for the top of a native function with a ``table``: ``enter_block`` as the function below."""


@wp.func_native(ENTER_IN_CPP + "return enter_block(block[0], block[1], block[2]);")
def enter_block(table: BlockArrays, block: wp.vec3i) -> int:
    """Enter a block unless it is there; returns ENTERED, PRESENT, or what stands in the way.

    A new block has the next number at once. TABLE_FULL means that it was not given one: the table has to grow, and
    everything be entered again.
    """


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
def _enter_numbered(
    known: wp.array(dtype=wp.vec3i),
    table: BlockArrays,
) -> None:
    number = wp.tid()
    key = block_key(known[number])
    capacity = table.keys.shape[0]
    slot = first_slot(key, capacity)
    while claim_slot(table.keys, slot, key) != _EMPTY:
        slot = (slot + 1) & (capacity - 1)
    table.numbers[slot] = number
    table.blocks[number] = known[number]


class BlockTable:
    """The hash and the list of its blocks, on one device.

    ``arrays`` is what kernels take. At most half of the slots are ever in use. ``max_blocks`` bounds the count: growing
    past it raises BlockLimitError. ``count`` is the number of blocks as the host last read it, by ``read_count``.
    """

    def __init__(self, *, device: Device, max_blocks: int, capacity: int = 1 << 14) -> None:
        self.device = device
        self.max_blocks = max_blocks
        self.count = 0
        self.arrays = self._empty(capacity)

    @property
    def capacity(self) -> int:
        """The number of slots."""
        return int(self.keys.shape[0])

    @property
    def keys(self) -> wp.array:
        """The hash's keys (capacity,), −1 where a slot is empty."""
        return self.arrays.keys

    @property
    def numbers(self) -> wp.array:
        """The block number in each slot (capacity,), −1 where it is empty."""
        return self.arrays.numbers

    @property
    def blocks(self) -> wp.array:
        """The block coordinates by number (≥ count,)."""
        return self.arrays.blocks

    def _empty(self, capacity: int) -> BlockArrays:
        arrays = BlockArrays()
        arrays.keys = wp.full(capacity, -1, dtype=wp.int64, device=self.device)
        arrays.numbers = wp.full(capacity, -1, dtype=int, device=self.device)
        arrays.blocks = wp.empty(min(capacity // 2, self.max_blocks), dtype=wp.vec3i, device=self.device)
        arrays.count = wp.zeros(1, dtype=int, device=self.device)
        return arrays

    def read_count(self) -> int:
        """Fetch the number of blocks from the device."""
        self.count = min(int(self.arrays.count.numpy()[0]), int(self.blocks.shape[0]))
        return self.count

    def grow(self) -> None:
        """Double the table; blocks that have a number keep it. Raises BlockLimitError past ``max_blocks``."""
        if self.read_count() >= self.max_blocks:
            raise BlockLimitError(f"the volume needs more than the {self.max_blocks:,} blocks that memory allows")
        self._rebuild(self.blocks, 2 * self.capacity)

    def drop_unnumbered(self) -> None:
        """Forget blocks that were entered where there was no room to number them, so that they can enter again."""
        self.read_count()
        self._rebuild(self.blocks, self.capacity)

    def _rebuild(self, blocks: wp.array, capacity: int) -> None:
        """Enter the first ``count`` of ``blocks`` into an empty hash, numbered in their order."""
        self.arrays = self._empty(capacity)
        if self.count:
            wp.launch(_enter_numbered, dim=self.count, inputs=[blocks], outputs=[self.arrays], device=self.device)
            self.arrays.count.fill_(self.count)

    def adopt(self, blocks: NDArray[np.int32]) -> None:
        """Fill an empty table with block coordinates (n, 3), all different, numbered in their order."""
        assert self.count == 0, "only an empty table adopts blocks"
        self._adopt(blocks)

    def _adopt(self, blocks: NDArray[np.int32]) -> None:
        if len(blocks) > self.max_blocks:
            raise BlockLimitError(f"{len(blocks):,} blocks are more than the {self.max_blocks:,} that memory allows")
        self.count = len(blocks)
        capacity = self.capacity
        while self.count > capacity // 2:
            capacity *= 2
        self._rebuild(wp.array(blocks, dtype=wp.vec3i, device=self.device), capacity)

    def sort(self) -> None:
        """Renumber the blocks in Morton order, so that neighbours in space become neighbours in memory.

        The numbers then depend on the blocks alone, not on which thread entered one first. For a table whose blocks
        have no voxels yet.
        """
        self._adopt(in_morton_order(self.blocks.numpy()[: self.read_count()]))


def in_morton_order(blocks: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return block coordinates (n, 3) sorted so that blocks which are near in space are near in the list."""
    code = np.zeros(len(blocks), dtype=np.uint64)
    fields = (blocks.astype(np.int64) + COORDINATE_LIMIT).astype(np.uint64)
    for bit in range(_COORDINATE_BITS):
        for axis in range(3):
            field_bit = (fields[:, axis] >> np.uint64(bit)) & np.uint64(1)
            code |= field_bit << np.uint64(3 * bit + 2 - axis)
    return blocks[np.argsort(code)]
