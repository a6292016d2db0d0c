"""Which processor Cycles renders on."""

from dataclasses import dataclass

import bpy

from datagen.errors import InputError

GPU_TYPES = ("optix", "cuda", "hip", "metal", "oneapi")
"""Best first; OptiX and CUDA are two ways to the same cards."""


@dataclass(frozen=True, kw_only=True)
class RenderDevice:
    """What renders: ``type`` is ``cpu`` or one of ``GPU_TYPES``; ``name`` is the hardware's own."""

    type: str
    name: str


def select_device(scene: bpy.types.Scene, wanted: str, *, require_gpu: bool = False) -> RenderDevice:
    """Set Cycles to the device type ``wanted``, or for ``auto`` to the best there is, and return what will render.

    Raises InputError where the device asked for, or with ``require_gpu`` any GPU, is not there: Cycles would render on
    the CPU without a word.
    """
    available = {kind: names for kind in GPU_TYPES if (names := _device_names(kind))}
    if wanted == "auto":
        wanted = next(iter(available), "cpu")
    if wanted == "cpu":
        if require_gpu:
            found = ", ".join(available) or "none"
            raise InputError(f"--require-gpu: this would render on the CPU; GPUs that Blender finds here: {found}")
        scene.cycles.device = "CPU"
        return RenderDevice(type="cpu", name=", ".join(_device_names("CPU")))
    if wanted not in available:
        found = ", ".join(["cpu", *available])
        raise InputError(f"--device {wanted}: Blender finds no such device here; there are: {found}")
    preferences = _preferences()
    preferences.compute_device_type = wanted.upper()
    for device in preferences.get_devices_for_type(wanted.upper()):
        device.use = device.type == wanted.upper()
    scene.cycles.device = "GPU"
    if not preferences.has_active_device():
        raise InputError(f"--device {wanted}: Blender lists {', '.join(available[wanted])} but cannot use it")
    return RenderDevice(type=wanted, name=", ".join(available[wanted]))


def _device_names(kind: str) -> list[str]:
    preferences = _preferences()
    offered = {"CPU", *(entry[0] for entry in preferences.get_device_types(bpy.context))}
    if kind.upper() not in offered:
        return []
    return [device.name for device in preferences.get_devices_for_type(kind.upper()) if device.type == kind.upper()]


def _preferences() -> bpy.types.AddonPreferences:
    return bpy.context.preferences.addons["cycles"].preferences
