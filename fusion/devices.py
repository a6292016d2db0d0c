"""Where kernels run: the CPU, on all of its cores, or a CUDA device."""

import os
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias, TypeVar

import psutil
import warp as wp
from warp.utils import array_scan

from datagen.errors import InputError
from datagen.progress import ProgressReporter, silent

Device: TypeAlias = Any
"""A Warp device; the type checker passes Warp over."""

_Item = TypeVar("_Item")

_STDERR = 2
_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"

Kernel: TypeAlias = Any
"""A Warp kernel."""


def resolve_device(name: str) -> Device:
    """Return the Warp device of ``auto``, ``cpu``, ``cuda`` or ``cuda:N``; auto takes CUDA where there is any.

    Raises InputError where the named device is not there: nothing ever falls back silently.
    """
    _start_warp()
    cuda = [str(device.alias) for device in wp.get_cuda_devices()]
    if name == "auto":
        return wp.get_device(cuda[0] if cuda else "cpu")
    alias = "cuda:0" if name == "cuda" else name
    if alias != "cpu" and alias not in cuda:
        raise InputError(f"--device {name}: not on this machine; there is {', '.join(['cpu', *cuda])}")
    return wp.get_device(alias)


def available_devices() -> list[str]:
    """Return the names of the devices that there are, ``cpu`` first."""
    _start_warp()
    return ["cpu", *(str(device.alias) for device in wp.get_cuda_devices())]


@cache
def _start_warp() -> None:
    """Start Warp without its banner, and without its word that there is no GPU, which no setting of it keeps back."""
    wp.config.log_level = wp.LOG_ERROR  # the banner would land on standard output
    with tempfile.TemporaryFile() as kept:
        errors = os.dup(_STDERR)
        os.dup2(kept.fileno(), _STDERR)
        try:
            wp.init()
        finally:
            os.dup2(errors, _STDERR)
            os.close(errors)
            kept.seek(0)
            os.write(_STDERR, b"".join(line for line in kept if _NO_DRIVER not in line))


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


def sum_before(counts: wp.array) -> None:
    """Replace each number of an array of int32, or of vectors of them, by the sum of those before it."""
    # Warp scans on whatever device is current, which need not be the array's where there are several.
    with wp.ScopedDevice(counts.device):
        array_scan(counts, counts, inclusive=False)


@dataclass(frozen=True, kw_only=True)
class Step:
    """A kernel that follows another one: its arguments but the first; ``threads`` of it belong to each index."""

    kernel: Kernel
    inputs: list[Any]
    outputs: list[Any]
    threads: int = 1


def launch_in_slabs(
    kernel: Kernel,
    *,
    dim: int,
    inputs: list[Any],
    outputs: list[Any],
    device: Device,
    block_dim: int = 256,
    least_slab: int = 1,
    then: Step | None = None,
) -> None:
    """Launch ``kernel`` over [0, dim); on the CPU in slabs on all cores.

    The kernel's first parameter is the index at which its slab begins, to be added to ``wp.tid()``. Its threads must
    not write to the same place: Warp's atomics are not atomic across CPU launches. Where a thread does little, a slab
    of fewer than ``least_slab`` is not worth a launch. ``then`` follows on each slab as soon as that is done: of what
    ``kernel`` writes it may read what belongs to its own index alone.
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
            then=then,
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
        then: Step | None = None,
    ) -> None:
        self._steps = [Step(kernel=kernel, inputs=inputs, outputs=outputs), *([then] if then else [])]
        # Loaded before the pool begins, or each thread would compile it.
        for step in self._steps:
            wp.load_module(step.kernel.module, device=device)
        self._device = device
        self._block_dim = block_dim if device.is_cuda else None
        self._dim = dim
        # Several slabs a core, so that a core which is done early takes over work.
        self._slab = dim if device.is_cuda else min(max(-(-dim // (8 * core_count())), least_slab), dim)
        self._idle: list[list[Any]] = []

    def run(self) -> None:
        """Launch the kernel, and on the CPU wait until it is done."""
        firsts = iter(range(0, self._dim, self._slab))

        def work() -> None:
            # Each thread has its own: a command holds the slab that it is at.
            try:
                commands = self._idle.pop()
            except IndexError:
                commands = self._recorded()
            for first in firsts:
                left = self._dim - first
                for step, command in zip(self._steps, commands, strict=True):
                    command.set_param_at_index_from_ctype(0, first * step.threads)
                    if left < self._slab:
                        command.set_dim(left * step.threads)
                    command.launch()
                    if left < self._slab:
                        command.set_dim(self._slab * step.threads)  # for the next run
            self._idle.append(commands)

        _on_all_cores(work, tasks=-(-self._dim // self._slab))

    def _recorded(self) -> list[Any]:
        """Pack the arguments, for a thread that comes for the first time."""
        return [
            wp.launch(
                step.kernel,
                dim=self._slab * step.threads,
                inputs=[0, *step.inputs],
                outputs=step.outputs,
                device=self._device,
                block_dim=self._block_dim,
                record_cmd=True,
            )
            for step in self._steps
        ]


def map_on_cores(function: Callable[[_Item], None], items: Sequence[_Item]) -> None:
    """Call ``function``, which should release the interpreter's lock, for each item on all cores."""
    left = iter(items)

    def work() -> None:
        for item in left:
            function(item)

    _on_all_cores(work, tasks=len(items))


def _on_all_cores(work: Callable[[], None], *, tasks: int) -> None:
    """Run ``work``, which shares out tasks, on this thread and on those of the pool."""
    others = [_pool().submit(work) for _ in range(min(core_count(), tasks) - 1)]
    try:
        work()
    finally:
        wait(others)
    for other in others:
        other.result()


def core_count() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(core_count(), thread_name_prefix="warp-slab")
