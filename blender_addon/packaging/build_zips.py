"""From the checkout to zips: a staged copy of the extension with its wheels, built by Blender's own tool."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from pathlib import Path

from blender_addon.packaging.check_bundle import check_bundle
from blender_addon.packaging.targets import PLATFORMS, PYTHONS, Platform
from blender_addon.packaging.wheel_files import CHECKOUT, build_own_wheel, download_wheels
from datagen.errors import InputError

EXTENSION = CHECKOUT / "blender_addon"
MANIFEST = "blender_manifest.toml"
WHEELS = "wheels"


def build_zips(
    output: Path, work: Path, *, platforms: Sequence[Platform] = PLATFORMS, with_wheels: bool = True
) -> list[Path]:
    """Build and validate the extension's zips and return them: one for each of ``platforms``, with wheels.

    Without wheels it is one for all platforms that holds the extension's code alone: it imports results, but cannot
    make them. ``work`` keeps what was downloaded. Raises InputError where a wheel cannot be had or does not fit, or
    where Blender's tool refuses the result.
    """
    stage = work / "stage"
    stage_extension(stage)
    if with_wheels:
        names = collect_wheels(stage / WHEELS, work, platforms)
        declare_wheels(stage / MANIFEST, [platform.name for platform in platforms], names)
    with tempfile.TemporaryDirectory(dir=work) as temporary:
        split = ["--split-platforms"] if with_wheels else []
        blender_ext("build", f"--source-dir={stage}", f"--output-dir={temporary}", *split)
        built = sorted(Path(temporary).glob("*.zip"))
        for path in built:
            blender_ext("validate", str(path))
        output.mkdir(parents=True, exist_ok=True)
        return [Path(shutil.move(path, output / path.name)) for path in built]


def stage_extension(stage: Path) -> None:
    """Copy the extension and the licence into the folder ``stage``, replacing what lies there."""
    shutil.rmtree(stage, ignore_errors=True)
    shutil.copytree(EXTENSION, stage, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(CHECKOUT / "LICENSE", stage)


def collect_wheels(folder: Path, work: Path, platforms: Sequence[Platform]) -> list[str]:
    """Put the wheels for ``platforms`` and every Python of Blender's into ``folder`` and return their file names."""
    folder.mkdir(parents=True)
    (work / WHEELS).mkdir(parents=True, exist_ok=True)
    own = build_own_wheel(work / WHEELS)
    names = set()
    for platform in platforms:
        for python in PYTHONS:
            wheels = download_wheels(platform, python, work / WHEELS / f"{platform.name}-{python.python}")
            check_bundle([own, *wheels], platform, python)
            for wheel in (own, *wheels):
                names.add(wheel.path.name)
                _link(wheel.path, folder / wheel.path.name)
    return sorted(names)


def declare_wheels(manifest: Path, platforms: Sequence[str], wheels: Sequence[str]) -> None:
    """Write ``platforms`` and ``wheels`` into the staged manifest; raises InputError where it names some already."""
    text = manifest.read_text(encoding="utf-8")
    if {"platforms", "wheels"} & tomllib.loads(text).keys():
        raise InputError(f"{manifest}: names platforms or wheels; remove them, they are written at build time")
    # Keys of the whole document come before its first table.
    keys, table, tables = text.partition("\n[")
    lines = [f'    "./{WHEELS}/{name}",' for name in wheels]
    listed = ", ".join(f'"{platform}"' for platform in platforms)
    keys += "\n".join(["", f"platforms = [{listed}]", "wheels = [", *lines, "]", ""])
    manifest.write_text(keys + table + tables, encoding="utf-8")


def blender_ext(*arguments: str) -> str:
    """Run Blender's command for extensions, which needs no Blender running, and return what it prints.

    It lies inside the bpy wheel. Raises InputError where it is not there or fails.
    """
    spec = importlib.util.find_spec("bpy")
    if spec is None or spec.origin is None:
        raise InputError("Blender's Python module, whose tool builds extensions, is not installed: pip install bpy")
    tools = sorted(Path(spec.origin).parent.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"))
    if not tools:
        raise InputError(f"{spec.origin}: brings no blender_ext.py; install bpy 4.2 or later")
    command = [sys.executable, str(tools[-1]), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    output = done.stdout + done.stderr
    if done.returncode or re.search(r"^\W*(warn|error|fatal)", output, re.IGNORECASE | re.MULTILINE):
        raise InputError(f"blender_ext.py {arguments[0]} failed:\n{output.strip()}")
    return output


def _link(source: Path, target: Path) -> None:
    """Make ``target`` the same file as ``source``, a copy where the file system cannot; there already, it stays."""
    if target.exists():
        return
    try:
        os.link(source, target)
    except OSError:
        shutil.copy(source, target)
