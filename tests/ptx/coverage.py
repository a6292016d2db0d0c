"""Which kernels ran on the device that tests stand in for."""

from collections.abc import Iterable
from typing import Any

import warp as wp

from ptx.device import Machine


def label(kernel: Any) -> str:
    """Return a kernel's name as ``Machine.launched`` counts it."""
    module = kernel.module.get_module_identifier().removeprefix("wp_").rsplit("_", 1)[0]
    return f"{module}:{kernel.get_mangled_name().rsplit('_', 1)[0]}"


def never_ran(machine: Machine, modules: Iterable[str], kernels: Iterable[Any] = ()) -> list[str]:
    """Return the names of kernels of ``modules``, or among ``kernels``, that no launch of these tests ran yet.

    So a test that asks is the last of its module, and comes with all others.
    """
    asked = [kernel for name in modules for kernel in wp.get_module(name).kernels.values()]
    return sorted({label(kernel) for kernel in [*asked, *kernels]} - set(machine.launched))
