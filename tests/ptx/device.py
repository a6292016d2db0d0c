"""A CUDA device for Warp whose kernels are PTX, run on the CPU.

Warp speaks to CUDA through functions of its native library, ``wp_cuda_…`` and their like. ``Machine`` stands in for
that library: compiling is NVRTC's as ever, what needs a driver is done here, all else is passed on. So the very host
code runs that would run on a GPU: streams, events, pinned memory, graphs.
"""

import ctypes
import itertools
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from ptx.compile import Kernel, Launch, load
from ptx.memory import Memory
from ptx.streams import Event, Graph, Streams

_CONTEXT = 0xC0DA
_CURRENT_STREAM = 2**64 - 1
_PROPERTIES = {
    "wp_cuda_device_get_count": 1,
    "wp_cuda_device_get_name": b"PTX on the CPU",
    "wp_cuda_device_get_arch": 90,
    "wp_cuda_device_get_sm_count": 132,
    "wp_cuda_device_get_max_shared_memory": 227 * 1024,
    "wp_cuda_device_is_uva": 1,
    "wp_cuda_device_get_pageable_memory_access": 0,
    "wp_cuda_device_get_direct_managed_mem_access_from_host": 0,
    "wp_cuda_device_get_host_native_atomic_supported": 0,
    "wp_cuda_device_get_managed_memory_supported": 0,
    "wp_cuda_device_get_concurrent_managed_access_supported": 0,
    "wp_cuda_device_is_mempool_supported": 1,
    "wp_cuda_device_is_ipc_supported": 0,
    "wp_cuda_device_get_uuid": None,
    "wp_cuda_device_get_pci_domain_id": 0,
    "wp_cuda_device_get_pci_bus_id": 0,
    "wp_cuda_device_get_pci_device_id": 0,
    "wp_cuda_device_get_primary_context": _CONTEXT,
    "wp_cuda_driver_is_initialized": 1,
    "wp_cuda_driver_version": 13000,
    "wp_cuda_context_check": 0,
    "wp_cuda_context_get_device_ordinal": 0,
    "wp_cuda_context_is_primary": 1,
    "wp_cuda_stream_register": None,
    "wp_cuda_stream_unregister": None,
    "wp_cuda_stream_is_blocking": 1,
    "wp_cuda_stream_get_priority": 0,
    "wp_cuda_configure_kernel_shared_memory": True,
    "wp_cuda_unload_module": None,
}
_NEEDS_A_DRIVER = ("wp_cuda_", "wp_memcpy_", "wp_memset_device", "wp_memtile_device", "wp_alloc_", "wp_free_")
_PASSED_ON = {
    "wp_alloc_host",
    "wp_free_host",
    "wp_memcpy_h2h",
    "wp_cuda_compile_program",
    "wp_cuda_toolkit_version",
    "wp_alloc_tracker_is_enabled",
}
# What objects do as they end, and that around which they do it.
_BY_COLLECTOR = ("_destroy", "_destroy_device", "free_device_async", "free_device_default", "free_pinned", "_current")


def _number(value: Any) -> int:
    """Return a handle or an address, however ctypes was handed it."""
    if value is None:
        return 0
    if hasattr(value, "contents"):
        return ctypes.addressof(value.contents)
    return int(value) if isinstance(value, int) else int(getattr(value, "value", None) or 0)


def _constant(value: Any) -> Callable[..., Any]:
    return lambda *_: value


class Machine:
    """Warp's native library with a CUDA device in it.

    ``late`` runs nothing before it is waited for; ``order`` is that of threads and blocks: 0 ascending, 1 descending,
    else scattered; ``optimise`` compiles longer for kernels that run faster.
    """

    def __init__(self, core: Any, *, late: bool = False, order: int = 0, optimise: bool = False) -> None:
        self.core = core
        self.memory = Memory()
        self.streams = Streams(late=late)
        self.order = order
        self.optimise = optimise
        self.launched: Counter[str] = Counter()
        self.loaded: list[str] = []
        self.device: Any = None
        self._handles: dict[int, Any] = {}
        self._numbers = itertools.count(1)
        self._contexts: list[int | None] = [None]
        self._graphs_own: set[int] = set()
        self._lock = threading.RLock()
        self._inside = False
        self._put_off: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []

    def __getattr__(self, name: str) -> Any:
        if not name.startswith("wp_"):
            raise AttributeError(name)
        done_here = getattr(type(self), "do_" + name.removeprefix("wp_"), None)
        needs_a_driver = name.startswith(_NEEDS_A_DRIVER) or name.endswith("_device")
        if done_here is not None:
            function = self._locked(done_here)
        elif name in _PROPERTIES:
            function = _constant(_PROPERTIES[name])
        elif needs_a_driver and name not in _PASSED_ON:
            raise NotImplementedError(f"{name}: not among the functions of a CUDA device that tests stand in for")
        else:
            function = getattr(self.core, name)
        self.__dict__[name] = function  # found at once the next time
        return function

    def _locked(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that one thread runs at a time.

        Python collects garbage whenever it likes, also within one of these: what that frees waits for its end.
        """

        def call(*args: Any) -> Any:
            with self._lock:
                if self._inside:
                    assert function.__name__.endswith(_BY_COLLECTOR), function.__name__
                    self._put_off.append((function, args))
                    return None
                self._inside = True
                try:
                    return function(self, *args)
                finally:
                    while self._put_off:
                        put_off, its_args = self._put_off.pop(0)
                        put_off(self, *its_args)
                    self._inside = False

        return call

    def _handle(self, what: Any) -> int:
        number = next(self._numbers)
        self._handles[number] = what
        return number

    def _stream(self, stream: Any) -> int:
        number = _number(stream)
        return self.streams.current if number == _CURRENT_STREAM else number

    # Contexts.

    def do_cuda_context_get_current(self) -> int | None:
        return self._contexts[-1]

    def do_cuda_context_set_current(self, context: Any) -> None:
        self._contexts[-1] = _number(context) or None

    def do_cuda_context_push_current(self, context: Any) -> None:
        self._contexts.append(_number(context) or None)

    def do_cuda_context_pop_current(self) -> None:
        self._contexts.pop()

    def do_cuda_context_synchronize(self, _context: Any) -> bool:
        self.streams.synchronize()
        return True

    def do_cuda_context_set_stream(self, _context: Any, stream: Any, sync: int) -> None:
        number = self._stream(stream)
        if sync and self.streams.current != number:
            event = Event()
            self.streams.record(event, self.streams.current)
            self.streams.wait(number, event)
        self.streams.current = number

    def do_cuda_device_get_memory_info(self, _ordinal: int, free: Any, total: Any) -> None:
        memory = psutil.virtual_memory()
        for pointer, value in ((free, memory.available), (total, memory.total)):
            if pointer is not None:
                pointer._obj.value = value

    # Memory.

    def do_alloc_device_async(self, _context: Any, size: int, stream: Any, _tag: Any) -> int:
        begin = self.memory.allocate(size, pinned=False)
        number = self._stream(stream)
        # There from this operation of the stream on, in a graph at each launch: other streams have to wait for it.
        self.streams.issue(number, lambda: self.memory.poison(begin))
        if self.streams.streams[number].capture is not None:
            self._graphs_own.add(begin)
        return begin

    def do_free_device_async(self, _context: Any, pointer: Any, _node: Any) -> None:
        begin = _number(pointer)
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
        self.memory.free(_number(pointer))

    def do_alloc_pinned(self, size: int, _tag: Any) -> int:
        self.streams.refuse_in_capture("allocating pinned memory")
        return self.memory.allocate(size, pinned=True)

    def do_free_pinned(self, pointer: Any) -> None:
        if not self.streams.capturing():
            self.streams.synchronize()
            self.memory.free(_number(pointer))

    # Copies.

    def _copy(self, target: Any, source: Any, size: int, stream: Any) -> bool:
        to, of, number = _number(target), _number(source), self._stream(stream)

        def work() -> None:
            ctypes.memmove(self.memory.real(to, size), self.memory.real(of, size), size)

        self.streams.issue(number, work)
        return True

    def do_memcpy_h2d(self, _context: Any, target: Any, source: Any, size: int, stream: Any) -> bool:
        if self.memory.is_known(_number(source)):
            return self._copy(target, source, size, stream)
        # Pageable memory is read before the call returns.
        self.streams.refuse_in_capture("copying from memory that is not pinned")
        held, to = ctypes.string_at(_number(source), size), _number(target)
        self.streams.issue(
            self._stream(stream), lambda: ctypes.memmove(self.memory.real(to, size), held, size) and None
        )
        return True

    def do_memcpy_d2h(self, _context: Any, target: Any, source: Any, size: int, stream: Any) -> bool:
        pinned = self.memory.is_known(_number(target))
        if not pinned:
            self.streams.refuse_in_capture("copying to memory that is not pinned")
        self._copy(target, source, size, stream)
        if not pinned:
            self.streams.synchronize(self._stream(stream))
        return True

    def do_memcpy_d2d(self, _context: Any, target: Any, source: Any, size: int, stream: Any) -> bool:
        return self._copy(target, source, size, stream)

    def do_memset_device(self, _context: Any, target: Any, value: int, size: int, stream: Any) -> bool:
        to = _number(target)
        self.streams.issue(
            self._stream(stream), lambda: ctypes.memset(self.memory.real(to, size), value, size) and None
        )
        return True

    def do_memtile_device(self, _context: Any, target: Any, source: Any, size: int, count: int) -> None:
        to, tile = _number(target), ctypes.string_at(_number(source), size)
        self.streams.issue(
            self.streams.current,
            lambda: ctypes.memmove(self.memory.real(to, size * count), tile * count, size * count) and None,
        )

    def _there(self, array: Any) -> Any:
        """Return the description of an array, with the address at which its data lie on the host."""
        copy = type(array).from_buffer_copy(array)
        copy.data = self.memory.real(_number(array.data), 0)
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
        if self._contexts[-1] != _CONTEXT:
            raise RuntimeError("a scan while the array's device is not the current one")

        def work() -> None:
            places = (self.memory.real(_number(place), 4 * count) for place in (source, target))
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

    # Streams, events, graphs.

    def do_cuda_stream_create(self, _context: Any, _priority: int) -> int:
        number = next(self._numbers)
        self.streams.streams[number] = type(self.streams.streams[0])()
        return number

    def do_cuda_stream_destroy(self, _context: Any, stream: Any) -> None:
        gone = self.streams.streams[_number(stream)]
        if gone.last is not None:
            self.streams.streams[0].waits.append(gone.last)
        del self.streams.streams[_number(stream)]

    def do_cuda_stream_query(self, stream: Any) -> int:
        last = self.streams.streams[self._stream(stream)].last
        return 0 if last is None or last.done else 600

    def do_cuda_stream_synchronize(self, stream: Any) -> bool:
        self.streams.synchronize(self._stream(stream))
        return True

    def do_cuda_stream_is_capturing(self, stream: Any) -> int:
        return int(self.streams.streams[self._stream(stream)].capture is not None)

    def do_cuda_stream_get_capture_id(self, stream: Any) -> int:
        return self._stream(stream) + 1

    def do_cuda_stream_wait_event(self, stream: Any, event: Any, _external: Any) -> None:
        self.streams.wait(self._stream(stream), self._handles[_number(event)])

    def do_cuda_stream_wait_stream(self, stream: Any, other: Any, event: Any, _external: Any) -> None:
        self.streams.record(self._handles[_number(event)], self._stream(other))
        self.streams.wait(self._stream(stream), self._handles[_number(event)])

    def do_cuda_event_create(self, _context: Any, _flags: int) -> int:
        return self._handle(Event())

    def do_cuda_event_destroy(self, event: Any) -> None:
        del self._handles[_number(event)]

    def do_cuda_event_record(self, event: Any, stream: Any, _external: Any) -> None:
        self.streams.record(self._handles[_number(event)], self._stream(stream))

    def do_cuda_event_query(self, event: Any) -> int:
        operation = self._handles[_number(event)].operation
        return 0 if operation is None or operation.done else 600

    def do_cuda_event_synchronize(self, event: Any) -> bool:
        self.streams.refuse_in_capture("waiting for an event")
        self.streams.finish(self._handles[_number(event)].operation)
        return True

    def do_cuda_graph_begin_capture(self, _context: Any, stream: Any, _external: int, _mode: int) -> bool:
        self.streams.begin_capture(self._stream(stream))
        return True

    def do_cuda_graph_end_capture(self, _context: Any, stream: Any, graph: Any) -> bool:
        graph._obj.value = self._handle(self.streams.end_capture(self._stream(stream)))
        return True

    def do_cuda_graph_create_exec(self, _context: Any, _stream: Any, graph: Any, executable: Any) -> bool:
        executable._obj.value = self._handle(self._handles[_number(graph)])
        return True

    def do_cuda_graph_launch(self, executable: Any, stream: Any) -> bool:
        held = self._handles[_number(executable)]
        assert isinstance(held, Graph), "a graph is launched"
        self.streams.launch(held, self._stream(stream))
        return True

    def do_cuda_graph_destroy(self, _context: Any, graph: Any) -> bool:
        del self._handles[_number(graph)]
        return True

    def do_cuda_graph_exec_destroy(self, _context: Any, executable: Any) -> bool:
        del self._handles[_number(executable)]
        return True

    # Kernels.

    def do_cuda_load_module(self, _context: Any, path: bytes) -> int:
        place = Path(path.decode())
        self.loaded.append(place.name)
        library = load(place.read_bytes().decode("latin1"), place.parent, optimise=self.optimise)
        return self._handle((library, place.name.removeprefix("wp_").rsplit("_", 1)[0]))

    def do_cuda_get_kernel(self, _context: Any, module: Any, name: bytes) -> int:
        library, module_name = self._handles[_number(module)]
        return self._handle(Kernel(library, name.decode(), module_name))

    def do_cuda_launch_kernel(
        self,
        _context: Any,
        kernel: Any,
        dim: int,
        max_blocks: int,
        block_dim: int,
        grid_stride: int,
        cluster_dim: int,
        shared_bytes: int,
        args: Any,
        stream: Any,
        _apic: Any,
    ) -> int:
        if not grid_stride or cluster_dim > 1:
            raise NotImplementedError("a launch of a kernel that is not grid-stride")
        if dim == 0:
            return 0
        held: Kernel = self._handles[_number(kernel)]
        block = block_dim if block_dim > 0 else 256
        blocks = min(-(-dim // block), max_blocks if max_blocks > 0 else 2**31 - 1)
        params = held.packed(args)

        def work() -> None:
            launch = Launch(block=block, shared_bytes=shared_bytes, order=self.order)
            launch.grid[:] = (blocks, 1, 1)
            self.memory.show(launch)
            self.launched[held.label] += 1
            held.run(launch, params)

        self.streams.issue(self._stream(stream), work)
        return 0
