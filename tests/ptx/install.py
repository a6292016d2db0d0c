"""Putting the device into Warp, and taking it out again."""

import atexit
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import warp as wp
from warp._src import context

from fusion.devices import resolve_device
from ptx.device import Machine

_SETTINGS = {
    "cuda_output": "ptx",
    # No kernel is to be given an array of another device: on this one it might even work.
    "launch_array_access_mode": wp.config.LaunchArrayAccessMode.STRICT,
}


def _machine(*, optimise: bool) -> Machine:
    """Return Warp's native library with the device in it; once put there it stays: things of the device outlive it."""
    resolve_device("cpu")
    runtime = context.runtime
    if not isinstance(runtime.core, Machine):
        runtime.core = Machine(runtime.core, optimise=optimise)
        runtime.driver_version = (13, 0)
        runtime.cuda_custom_context_count = [0]
        runtime.default_ptx_arch = 90
    return runtime.core


def _device(machine: Machine) -> context.Device:
    if machine.device is None:
        machine.device = context.Device(context.runtime, "cuda:0", ordinal=0, is_primary=True)
    return machine.device


def install(machine: Machine) -> None:
    """Let Warp find a CUDA device, as it does where there is one; it becomes Warp's default, as there."""
    runtime = context.runtime
    assert not runtime.cuda_devices, "a real device needs none beside it"
    device = _device(machine)
    runtime.cuda_devices.append(device)
    runtime.cuda_primary_devices.append(device)
    runtime.device_map["cuda:0"] = device
    runtime.set_default_device("cuda:0")
    for name, value in _SETTINGS.items():
        setattr(wp.config, name, value)


def _uninstall(settings: dict[str, Any]) -> None:
    runtime = context.runtime
    runtime.cuda_devices.clear()
    runtime.cuda_primary_devices.clear()
    del runtime.device_map["cuda:0"]
    runtime.set_default_device("cpu")
    for name, value in settings.items():
        setattr(wp.config, name, value)


@contextmanager
def ptx_device(*, late: bool = False, order: int = 0) -> Iterator[Machine]:
    """Have Warp's ``cuda:0`` be PTX on the CPU: see ``Machine``; what it ``launched`` is counted from now on."""
    machine = _machine(optimise=False)
    machine.launched.clear()
    settings = {name: getattr(wp.config, name) for name in _SETTINGS}
    install(machine)
    machine.order, machine.streams.late = order, late
    try:
        yield machine
        machine.streams.synchronize()
    finally:
        machine.order, machine.streams.late = 0, False
        _uninstall(settings)


def install_for_all(asked: str) -> None:
    """Have a device for the whole process: ``late``, or the order of threads as a number, 1 for ascending."""
    machine = _machine(optimise=True)
    machine.streams.late = asked == "late"
    machine.order = int(asked) - 1 if asked.isdigit() else 0
    install(machine)

    def report() -> None:
        place = os.environ.get("SCANBACK_PTX_REPORT")
        if place:
            with open(place, "a") as file:
                file.writelines(f"{count} {name}\n" for name, count in sorted(machine.launched.items()))

    atexit.register(report)
