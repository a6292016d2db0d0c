"""Do the wheels of a zip fit each other, and the NumPy of every Blender that the zip is for?"""

from collections.abc import Mapping, Sequence

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from blender_addon.packaging.targets import BlenderPython, Platform
from blender_addon.packaging.wheel_files import Wheel
from datagen.errors import InputError

LEFT_OUT = {
    "embreex": "only 'datagen validate' casts rays at meshes with it, and does without where it is not there",
}
"""Requirements of Scanback that do not travel, and why."""


def check_bundle(wheels: Sequence[Wheel], platform: Platform, python: BlenderPython) -> None:
    """Raise InputError unless all that the wheels require is among them, in a version they accept.

    NumPy is Blender's: each version that it comes in must be accepted.
    """
    present = {wheel.name: wheel.version for wheel in wheels}
    if "numpy" in present:
        raise InputError(f"{platform.name}: NumPy must not travel, it is Blender's own; remove it from the pins")
    environment = _environment(platform, python)
    for wheel in wheels:
        for requirement in wheel.requirements:
            if requirement.marker is not None and not requirement.marker.evaluate(environment):
                continue
            complaint = _complaint(requirement, present, python)
            if complaint:
                where = f"{wheel.path.name} in {platform.name}, Python {python.python}"
                raise InputError(f"{where}: asks for {requirement}, but {complaint}; change wheels.txt")


def _complaint(requirement: Requirement, present: Mapping[str, Version], python: BlenderPython) -> str | None:
    name = canonicalize_name(requirement.name)
    if name == "numpy":
        unfit = [version for version in python.numpy if version not in requirement.specifier]
        return f"Blender {python.blender} brings {', '.join(unfit)}" if unfit else None
    if name in LEFT_OUT:
        return None
    if name not in present:
        return "there is none"
    return None if str(present[name]) in requirement.specifier else f"there is {present[name]}"


def _environment(platform: Platform, python: BlenderPython) -> dict[str, str]:
    """Return what markers ask about, no extra being wanted."""
    return {
        "implementation_name": "cpython",
        "platform_python_implementation": "CPython",
        "os_name": "nt" if platform.name.startswith("windows") else "posix",
        "python_version": python.python,
        "python_full_version": f"{python.python}.0",
        "extra": "",
        **dict(platform.markers),
    }
