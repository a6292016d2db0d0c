"""Wheels: which ones are asked for, where they come from, what they say of themselves."""

import hashlib
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from email.parser import Parser
from functools import cached_property
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name, parse_wheel_filename
from packaging.version import Version

from blender_addon.packaging.targets import BlenderPython, Platform
from datagen.errors import InputError

CHECKOUT = Path(__file__).parents[2]
PINS_FILE = Path(__file__).with_name("wheels.txt")
SOURCES = ("datagen", "fusion", "blender_addon", "scenes", "pyproject.toml", "README.md", "LICENSE")
"""What Scanback's own wheel is built from. The copy is clean: old build folders leak into setuptools' wheels."""


@dataclass(frozen=True)
class Wheel:
    """A wheel file; ``name`` is canonical, as in ``opencv-python-headless``."""

    path: Path

    @cached_property
    def name(self) -> str:
        """The project's canonical name."""
        return parse_wheel_filename(self.path.name)[0]

    @cached_property
    def version(self) -> Version:
        """The project's version."""
        return parse_wheel_filename(self.path.name)[1]

    @cached_property
    def requirements(self) -> tuple[Requirement, ...]:
        """What it asks for, extras and markers included, from its METADATA."""
        with zipfile.ZipFile(self.path) as archive:
            (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
            headers = Parser().parsestr(archive.read(metadata).decode(), headersonly=True)
        return tuple(Requirement(text) for text in headers.get_all("Requires-Dist", []))


def read_pins(path: Path = PINS_FILE) -> dict[str, Version]:
    """Return the versions by canonical name that ``path`` pins; raises InputError for what is not ``name==version``."""
    pins: dict[str, Version] = {}
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        name, separator, version = text.partition("==")
        if not separator or "*" in version:
            raise InputError(f"{path}:{number}: expected name==version, found {text!r}; pin one version")
        pins[canonicalize_name(name)] = Version(version)
    return pins


def download_wheels(platform: Platform, python: BlenderPython, folder: Path) -> list[Wheel]:
    """Return the pinned wheels for one platform and Python, downloaded into ``folder`` where they are not there yet.

    Raises InputError where pip cannot get them.
    """
    pins = read_pins()
    if found := _complete(pins, folder):
        return found
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--only-binary=:all:", "--implementation=cp", f"--python-version={python.python}"]
    command += [f"--platform={tag}" for tag in platform.tags]
    command += [f"--requirement={PINS_FILE}", f"--dest={folder}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own arguments
    if done.returncode:
        raise InputError(
            f"{PINS_FILE}: pip cannot download the wheels for {platform.name}, Python {python.python}; "
            f"check the network and the versions:\n{done.stderr.strip()}"
        )
    found = _complete(pins, folder)
    if found is None:
        raise InputError(f"{folder}: wheels are missing after the download; remove the folder and try again")
    return found


def build_own_wheel(folder: Path) -> Wheel:
    """Return Scanback's own wheel, built by pip from a clean copy of this checkout into ``folder``.

    Its version ends with a digest of the sources: Blender unpacks no wheel of a name and version that it has unpacked
    before, so another zip of the same version would be installed with the old code.
    """
    for old in folder.glob("scanback-*.whl"):
        old.unlink()
    with tempfile.TemporaryDirectory() as temporary:
        copy = Path(temporary)
        for name in SOURCES:
            source = CHECKOUT / name
            if source.is_dir():
                shutil.copytree(source, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(source, copy / name)
        project = copy / "pyproject.toml"
        text = project.read_text(encoding="utf-8")
        numbered = re.sub(r'^(version = "[^"]+)"', rf'\1+{_digest(copy)}"', text, count=1, flags=re.MULTILINE)
        project.write_text(numbered, encoding="utf-8")
        command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--disable-pip-version-check", "--no-deps"]
        command += [f"--wheel-dir={folder}", str(copy)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode:
        raise InputError(f"{CHECKOUT}: pip cannot build Scanback's wheel:\n{done.stderr.strip()}")
    (built,) = folder.glob("scanback-*.whl")
    return Wheel(built)


def _digest(folder: Path) -> str:
    """Return twelve hexadecimal digits that change with any file in ``folder`` or its name."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(folder).as_posix()} {len(content)} ".encode() + content)
    return digest.hexdigest()[:12]


def _complete(pins: dict[str, Version], folder: Path) -> list[Wheel] | None:
    """Return the wheels in ``folder`` that ``pins`` name, None where one is missing; others that lie there are old."""
    wheels = [Wheel(path) for path in sorted(folder.glob("*.whl"))]
    pinned = [wheel for wheel in wheels if pins.get(wheel.name) == wheel.version]
    return pinned if {wheel.name for wheel in pinned} == pins.keys() else None
