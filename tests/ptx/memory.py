"""A device's memory: addresses that only the device can read."""

import bisect
import ctypes
from typing import Any

from ptx.compile import Range

# No program of this machine has memory there: host code that reads a device's address is cut off at once.
_BEGIN, _END = 1 << 52, 1 << 53
_POISON = 0xAB


class Memory:
    """The allocations of a device, and the host memory that it may read because that is pinned."""

    def __init__(self) -> None:
        self._next = _BEGIN
        self._begins: list[int] = []
        self._held: dict[int, tuple[int, int, Any]] = {}
        self.age = 1
        self._table: Any = None
        self.hosts_own = 0

    def allocate(self, size: int, *, pinned: bool) -> int:
        """Return the address of new memory, full of what nobody wrote."""
        backing = (ctypes.c_uint8 * (size + 256))()
        ctypes.memset(backing, _POISON, len(backing))
        there = -(-ctypes.addressof(backing) // 256) * 256
        begin = there if pinned else self._next
        if not pinned:
            # Never twice the same address, and far apart: what is freed or passed is no other array's.
            self._next += -(-size // 4096) * 4096 + 4096
        bisect.insort(self._begins, begin)
        self._held[begin] = (begin + size, there - begin, backing)
        self.age, self._table = self.age + 1, None
        return begin

    def free(self, begin: int) -> None:
        """Take an allocation away from the device."""
        self._begins.remove(begin)
        del self._held[begin]
        self.age, self._table = self.age + 1, None

    def poison(self, begin: int) -> None:
        """Fill an allocation with what nobody wrote."""
        end, moved, _ = self._held[begin]
        ctypes.memset(begin + moved, _POISON, end - begin)

    def is_known(self, address: int) -> bool:
        """Tell whether an address lies in an allocation, or in pinned memory."""
        at = bisect.bisect_right(self._begins, address) - 1
        return at >= 0 and address < self._held[self._begins[at]][0]

    def real(self, address: int | None, size: int) -> int | None:
        """Return where ``size`` bytes of the device's memory lie on the host; other addresses are the host's own."""
        if not address:
            return address
        at = bisect.bisect_right(self._begins, address) - 1
        if at >= 0 and address < self._held[self._begins[at]][0]:
            end, moved, _ = self._held[self._begins[at]]
            if address + size > end:
                raise RuntimeError(f"{size} bytes from 0x{address:x} on: beyond an array's end")
            return address + moved
        if _BEGIN <= address < _END:
            raise RuntimeError(f"0x{address:x}: no memory of the device, or freed")
        return address

    def show(self, launch: Any) -> None:
        """Tell a launch which memory there is."""
        if self._table is None:
            self._table = (Range * max(len(self._begins), 1))(
                *(Range(begin, self._held[begin][0], self._held[begin][1] % 2**64) for begin in self._begins)
            )
        launch.age, launch.ranges_count = self.age, len(self._begins)
        launch.ranges = ctypes.addressof(self._table)
        launch.device_begin, launch.device_end = _BEGIN, _END if self.hosts_own else 0
