"""What the zips are for: platforms, and the Python and NumPy that Blender's releases bring along."""

import platform
import sys
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Platform:
    """A platform as Blender names it, pip's tags for it, best first, and the markers that requirements ask about.

    ``tags`` hold what the oldest system runs that a supported Blender runs on, where there are wheels for that.
    """

    name: str
    tags: tuple[str, ...]
    markers: tuple[tuple[str, str], ...]


@dataclass(frozen=True, kw_only=True)
class BlenderPython:
    """A Python that Blender releases bring along, with the NumPy versions that came with it."""

    blender: str
    python: str
    numpy: tuple[str, ...]


GLIBC_TAGS = tuple(
    f"manylinux{version}_x86_64" for version in ("_2_28", "_2_27", "_2_26", "_2_24", "_2_17", "2014", "_2_12", "2010")
)
"""Blender 4.2 and later ask for glibc 2.28."""

PLATFORMS = (
    Platform(
        name="linux-x64",
        tags=GLIBC_TAGS,
        markers=(("sys_platform", "linux"), ("platform_system", "Linux"), ("platform_machine", "x86_64")),
    ),
    Platform(
        name="windows-x64",
        tags=("win_amd64",),
        markers=(("sys_platform", "win32"), ("platform_system", "Windows"), ("platform_machine", "AMD64")),
    ),
    # SciPy has nothing older than macOS 12. Warp has nothing for Intel.
    Platform(
        name="macos-arm64",
        tags=("macosx_12_0_arm64", "macosx_12_0_universal2"),
        markers=(("sys_platform", "darwin"), ("platform_system", "Darwin"), ("platform_machine", "arm64")),
    ),
)

PYTHONS = (
    BlenderPython(blender="4.2 to 5.0", python="3.11", numpy=("1.24.3", "1.26.4")),  # 1.26 since Blender 4.4
    BlenderPython(blender="5.1 and later", python="3.13", numpy=("2.2.4", "2.3.0", "2.3.4")),  # 2.2: Debian's 4.3
)


def this_platform() -> Platform | None:
    """Return the platform that this program runs on, None where there is no zip for it."""
    here = (sys.platform, platform.machine())
    for candidate in PLATFORMS:
        markers = dict(candidate.markers)
        if here == (markers["sys_platform"], markers["platform_machine"]):
            return candidate
    return None
