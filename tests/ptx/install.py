"""Putting the device into Warp, and taking it out again."""

import atexit
import os
from collections.abc import Iterator
from contextlib import contextmanager

import warp as wp
from warp._src import context

from fusion.devices import resolve_device
from ptx.device import Machine


def install(machine: Machine) -> None:
    """Let Warp find a CUDA device, as it does where there is one; it becomes Warp's default, as there."""
    runtime = context.runtime
    assert not runtime.cuda_devices, "a real device needs none beside it"
    runtime.core = machine
    runtime.driver_version = (13, 0)
    runtime.cuda_custom_context_count = [0]
    runtime.default_ptx_arch = 90
    wp.config.cuda_output = "ptx"
    wp.config.launch_array_access_mode = wp.config.LaunchArrayAccessMode.STRICT
    device = context.Device(runtime, "cuda:0", ordinal=0, is_primary=True)
    runtime.cuda_devices.append(device)
    runtime.cuda_primary_devices.append(device)
    runtime.device_map["cuda:0"] = device
    runtime.set_default_device("cuda:0")


@contextmanager
def ptx_device(*, late: bool = False, order: int = 0, optimise: bool = False) -> Iterator[Machine]:
    """Have Warp's ``cuda:0`` be PTX on the CPU."""
    resolve_device("cpu")
    machine = Machine(context.runtime.core, late=late, order=order, optimise=optimise)
    install(machine)
    yield machine


def install_for_all(asked: str) -> None:
    """Have a device for the whole process: ``late``, or the order of threads as a number (1 is said for 0)."""
    late = asked == "late"
    order = int(asked) - 1 if asked.isdigit() else 0
    machine = Machine(context.runtime.core, late=late, order=order, optimise=True)
    install(machine)

    def report() -> None:
        place = os.environ.get("SCANBACK_PTX_REPORT")
        if place:
            with open(place, "a") as file:
                file.writelines(f"{count} {name}\n" for name, count in sorted(machine.launched.items()))

    atexit.register(report)
