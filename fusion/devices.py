"""Where kernels run: the CPU, on all of its cores, or a CUDA device."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from typing import Any, TypeAlias, TypeVar

import psutil
import warp as wp

from datagen.errors import InputError
from datagen.progress import ProgressReporter, silent

Device: TypeAlias = Any
"""A Warp device; the type checker passes Warp over."""

_Item = TypeVar("_Item")

Kernel: TypeAlias = Any
"""A Warp kernel."""


def resolve_device(name: str) -> Device:
    """Return the Warp device of ``auto``, ``cpu``, ``cuda`` or ``cuda:N``; auto takes CUDA where there is any.

    Raises InputError where the named device is not there: nothing ever falls back silently.
    """
    wp.config.log_level = wp.LOG_ERROR  # its banner would land on standard output
    wp.init()
    cuda = [str(device.alias) for device in wp.get_cuda_devices()]
    if name == "auto":
        return wp.get_device(cuda[0] if cuda else "cpu")
    alias = "cuda:0" if name == "cuda" else name
    if alias != "cpu" and alias not in cuda:
        raise InputError(f"--device {name}: not on this machine; there is {', '.join(['cpu', *cuda])}")
    return wp.get_device(alias)


def available_devices() -> list[str]:
    """Return the names of the devices that there are, ``cpu`` first."""
    wp.config.log_level = wp.LOG_ERROR
    wp.init()
    return ["cpu", *(str(device.alias) for device in wp.get_cuda_devices())]


def free_memory(device: Device) -> int:
    """Return the bytes that can still be allocated on a device."""
    return int(device.free_memory) if device.is_cuda else int(psutil.virtual_memory().available)


def load_kernels(
    modules: Sequence[str], kernels: Sequence[Kernel] = (), *, device: Device, progress: ProgressReporter = silent
) -> None:
    """Compile kernel modules, or load them from the user's cache: the first time takes seconds, and is not timed.

    ``kernels`` are those with a module of their own.
    """
    loaded = [*modules, *(kernel.module for kernel in kernels)]
    advance = progress("kernels", len(loaded))
    for module in loaded:
        wp.load_module(module, device=device)
        advance()


def launch_in_slabs(
    kernel: Kernel,
    *,
    dim: int,
    inputs: list[Any],
    outputs: list[Any],
    device: Device,
    block_dim: int = 256,
    least_slab: int = 1,
) -> None:
    """Launch ``kernel`` over [0, dim); on the CPU in slabs on all cores.

    The kernel's first parameter is the index at which its slab begins, to be added to ``wp.tid()``. Its threads must
    not write to the same place: Warp's atomics are not atomic across CPU launches. Where a thread does little, a slab
    of fewer than ``least_slab`` is not worth a launch.
    """
    if dim > 0:
        SlabLaunch(
            kernel,
            dim=dim,
            inputs=inputs,
            outputs=outputs,
            device=device,
            block_dim=block_dim,
            least_slab=least_slab,
        ).run()


class SlabLaunch:
    """A launch over [0, dim), dim > 0, that can be made again and again: its arguments are packed once.

    They are those of ``launch_in_slabs``; what lies in their arrays is read each time that it runs.
    """

    def __init__(
        self,
        kernel: Kernel,
        *,
        dim: int,
        inputs: list[Any],
        outputs: list[Any],
        device: Device,
        block_dim: int = 256,
        least_slab: int = 1,
    ) -> None:
        # Loaded before the pool begins, or each thread would compile it.
        wp.load_module(kernel.module, device=device)
        cores = 1 if device.is_cuda else _core_count()
        # Several slabs a core, so that a core which is done early takes over work.
        self._slab = dim if device.is_cuda else min(max(-(-dim // (8 * cores)), least_slab), dim)
        self._dim = dim
        self._commands = [
            wp.launch(
                kernel,
                dim=self._slab,
                inputs=[0, *inputs],
                outputs=outputs,
                device=device,
                block_dim=block_dim if device.is_cuda else None,
                record_cmd=True,
            )
            for _ in range(min(cores, -(-dim // self._slab)))
        ]

    def run(self) -> None:
        """Launch the kernel, and on the CPU wait until it is done."""
        firsts = iter(range(0, self._dim, self._slab))
        idle = list(self._commands)

        def work() -> None:
            command = idle.pop()  # each thread has its own: a command holds the slab that it is at
            for first in firsts:
                command.set_param_at_index(0, first)
                if self._dim % self._slab:
                    command.set_dim(min(self._slab, self._dim - first))
                command.launch()

        _on_all_cores(work, tasks=len(self._commands))


def map_on_cores(function: Callable[[_Item], None], items: Sequence[_Item]) -> None:
    """Call ``function``, which should release the interpreter's lock, for each item on all cores."""
    left = iter(items)

    def work() -> None:
        for item in left:
            function(item)

    _on_all_cores(work, tasks=len(items))


def _on_all_cores(work: Callable[[], None], *, tasks: int) -> None:
    """Run ``work``, which shares out tasks, on this thread and on those of the pool."""
    others = [_pool().submit(work) for _ in range(min(_core_count(), tasks) - 1)]
    try:
        work()
    finally:
        wait(others)
    for other in others:
        other.result()


def _core_count() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_core_count(), thread_name_prefix="warp-slab")
