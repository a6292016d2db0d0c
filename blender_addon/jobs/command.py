"""The pipeline's command lines, run by the interpreter that Blender brings along."""

import importlib.util
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import bpy

from ..errors import ReconstructionError

BLENDER_VARIABLE = "SCANBACK_BLENDER"
"""Names the Blender application that renders, where there is no bpy module (see datagen.blender_program)."""
NEEDED = ("datagen", "fusion", "warp", "cv2")
"""Packages by which is seen where the extension's wheels, or what was installed beside bpy, lie."""


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command of ``datagen`` or ``fusion`` with its arguments, the command's name first.

    ``failure`` begins the sentence that tells of its failure.
    """

    program: str
    arguments: tuple[str, ...]
    failure: str

    def line(self) -> list[str]:
        """Return the whole command line; it reports progress as JSON and ends when its input does."""
        # -P: not what lies in the working folder; -s: not what the user installed for other interpreters.
        options = ("--progress", "json", "--end-with-input")
        return [sys.executable, "-P", "-s", "-m", self.program, *self.arguments, *options]


def environment() -> dict[str, str]:
    """Return the environment in which commands find their packages and the Blender that renders.

    They speak UTF-8, whatever the system's locale, as Blender does: paths are told with every letter. Raises
    ReconstructionError where a package is not installed.
    """
    folders = [str(_folder_of(package)) for package in NEEDED]
    found = {**os.environ, "PYTHONPATH": os.pathsep.join(dict.fromkeys(folders)), "PYTHONUNBUFFERED": "1"}
    found |= {"PYTHONUTF8": "1", "PYTHONIOENCODING": "utf-8"}
    if bpy.app.binary_path:  # empty in the bpy module; bpy.app.module is newer than Blender 4.3
        found[BLENDER_VARIABLE] = bpy.app.binary_path
    return found


def missing_packages() -> list[str]:
    """Return which of the needed packages are not installed."""
    return [package for package in NEEDED if importlib.util.find_spec(package) is None]


def _folder_of(package: str) -> Path:
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        raise ReconstructionError(
            f"The package {package} is not installed; install the extension for your platform from its zip, which "
            "brings it along, or 'pip install scanback' beside bpy"
        )
    return Path(spec.origin).parents[1]
