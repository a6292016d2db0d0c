"""The device's functions that allocate, copy, scan, and build hierarchies."""

import ctypes
from typing import Any

from ptx.device_state import CONTEXT, DeviceState, as_number


class MemoryFunctions(DeviceState):
    """Named as Warp's native functions, with ``do_`` for ``wp_``."""

    def do_alloc_device_async(self, _context: Any, size: int, stream: Any, _tag: Any) -> int:
        begin = self.memory.allocate(size, pinned=False)
        number = self._stream(stream)
        # There from this operation of the stream on, in a graph at each launch: other streams have to wait for it.
        self.streams.issue(number, lambda: self.memory.poison(begin))
        if self.streams.streams[number].capture is not None:
            self._graphs_own.add(begin)
        return begin

    def do_free_device_async(self, _context: Any, pointer: Any, _node: Any) -> None:
        begin = as_number(pointer)
        if begin in self._graphs_own:
            # The graph keeps it: the next launch writes there again.
            self._graphs_own.remove(begin)
            if self.streams.capturing():
                self.streams.issue(self.streams.current, lambda: self.memory.poison(begin))
            return
        if self.streams.capturing():
            return  # Warp puts it off to the end of the capture; here it is then kept
        # On the default stream, which comes after all that was issued.
        self.streams.issue(0, lambda: self.memory.free(begin))

    def do_alloc_device_default(self, _context: Any, size: int, _tag: Any) -> int:
        self.streams.refuse_in_capture("allocating memory that is no pool's")
        return self.memory.allocate(size, pinned=False)

    def do_free_device_default(self, _context: Any, pointer: Any) -> None:
        self.streams.synchronize()
        self.memory.free(as_number(pointer))

    def do_alloc_pinned(self, size: int, _tag: Any) -> int:
        self.streams.refuse_in_capture("allocating pinned memory")
        return self.memory.allocate(size, pinned=True)

    def do_free_pinned(self, pointer: Any) -> None:
        if not self.streams.capturing():
            self.streams.synchronize()
            self.memory.free(as_number(pointer))

    def _copy(self, target: Any, source: Any, size: int, stream: Any) -> bool:
        to, of, number = as_number(target), as_number(source), self._stream(stream)

        def work() -> None:
            ctypes.memmove(self.memory.real(to, size), self.memory.real(of, size), size)

        self.streams.issue(number, work)
        return True

    def do_memcpy_h2d(self, _context: Any, target: Any, source: Any, size: int, stream: Any) -> bool:
        if self.memory.is_known(as_number(source)):
            return self._copy(target, source, size, stream)
        # Pageable memory is read before the call returns.
        self.streams.refuse_in_capture("copying from memory that is not pinned")
        held, to = ctypes.string_at(as_number(source), size), as_number(target)
        self.streams.issue(
            self._stream(stream), lambda: ctypes.memmove(self.memory.real(to, size), held, size) and None
        )
        return True

    def do_memcpy_d2h(self, _context: Any, target: Any, source: Any, size: int, stream: Any) -> bool:
        pinned = self.memory.is_known(as_number(target))
        if not pinned:
            self.streams.refuse_in_capture("copying to memory that is not pinned")
        self._copy(target, source, size, stream)
        if not pinned:
            self.streams.synchronize(self._stream(stream))
        return True

    def do_memcpy_d2d(self, _context: Any, target: Any, source: Any, size: int, stream: Any) -> bool:
        return self._copy(target, source, size, stream)

    def do_memset_device(self, _context: Any, target: Any, value: int, size: int, stream: Any) -> bool:
        to = as_number(target)
        self.streams.issue(
            self._stream(stream), lambda: ctypes.memset(self.memory.real(to, size), value, size) and None
        )
        return True

    def do_memtile_device(self, _context: Any, target: Any, source: Any, size: int, count: int) -> None:
        to, tile = as_number(target), ctypes.string_at(as_number(source), size)
        self.streams.issue(
            self.streams.current,
            lambda: ctypes.memmove(self.memory.real(to, size * count), tile * count, size * count) and None,
        )

    def _there(self, array: Any) -> Any:
        """Return the description of an array, with the address at which its data lie on the host."""
        copy = type(array).from_buffer_copy(array)
        copy.data = self.memory.real(as_number(array.data), 0)
        return copy

    def do_array_copy_device(
        self, _context: Any, target: Any, source: Any, target_kind: int, source_kind: int, size: int
    ) -> bool:
        if (target_kind, source_kind) != (0, 0):
            raise NotImplementedError("a copy between arrays that are not plain")
        held = [type(a.contents).from_buffer_copy(a.contents) for a in (target, source)]

        def work() -> None:
            to, of = (self._there(array) for array in held)
            self.core.wp_array_copy_host(ctypes.byref(to), ctypes.byref(of), target_kind, source_kind, size)

        self.streams.issue(self.streams.current, work)
        return True

    def do_array_scan_int_device(self, source: int, target: int, count: int, *rest: Any) -> bool:
        # Unlike the others it is told no device: with several, the current one has to be the array's.
        if self._contexts[-1] != CONTEXT:
            raise RuntimeError("a scan while the array's device is not the current one")

        def work() -> None:
            places = (self.memory.real(as_number(place), 4 * count) for place in (source, target))
            self.core.wp_array_scan_int_host(*places, count, *rest)

        self.streams.issue(self.streams.current, work)
        return True

    def do_mesh_create_device(self, _context: Any, points: Any, velocities: Any, indices: Any, *rest: Any) -> int:
        # Built by Warp's host code: the same structure, of which a kernel follows the host's addresses.
        self.streams.synchronize()
        numbers, (winding, _constructor, groups, leaf) = rest[:2], rest[2:]
        arrays = (self._there(array) for array in (points, velocities, indices))
        self.memory.hosts_own += 1
        return int(self.core.wp_mesh_create_host(*arrays, *numbers, winding, 0, groups, leaf))

    def do_mesh_destroy_device(self, mesh: int) -> None:
        self.streams.synchronize()
        self.core.wp_mesh_destroy_host(mesh)
        self.memory.hosts_own -= 1
