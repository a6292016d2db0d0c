"""A CUDA device for Warp whose kernels are PTX, run on the CPU.

Warp speaks to CUDA through functions of its native library, ``wp_cuda_…`` and their like. ``Machine`` stands in for
that library: compiling is NVRTC's as ever, what needs a driver is done here, all else is passed on. So the very host
code runs that would run on a GPU: streams, events, pinned memory, graphs.
"""

import itertools
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from ptx.compile import Kernel, Launch, load
from ptx.device_memory import MemoryFunctions
from ptx.device_state import CONTEXT, as_number
from ptx.device_streams import StreamFunctions
from ptx.memory import Memory
from ptx.streams import Event, Streams

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
    "wp_cuda_device_get_primary_context": CONTEXT,
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


def _constant(value: Any) -> Callable[..., Any]:
    return lambda *_: value


class Machine(MemoryFunctions, StreamFunctions):
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

    # Contexts.

    def do_cuda_context_get_current(self) -> int | None:
        return self._contexts[-1]

    def do_cuda_context_set_current(self, context: Any) -> None:
        self._contexts[-1] = as_number(context) or None

    def do_cuda_context_push_current(self, context: Any) -> None:
        self._contexts.append(as_number(context) or None)

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

    # Kernels.

    def do_cuda_load_module(self, _context: Any, path: bytes) -> int:
        place = Path(path.decode())
        self.loaded.append(place.name)
        library = load(place.read_bytes().decode("latin1"), place.parent, optimise=self.optimise)
        return self._handle((library, place.name.removeprefix("wp_").rsplit("_", 1)[0]))

    def do_cuda_get_kernel(self, _context: Any, module: Any, name: bytes) -> int:
        library, module_name = self._handles[as_number(module)]
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
        held: Kernel = self._handles[as_number(kernel)]
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
