"""Values read from a JSON file, each with the place it came from, so that an error can name it."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from ..errors import ReconstructionError

RIGID_TOLERANCE = 1e-3
"""Largest entry of RᵀR − I that is taken for rounding."""


@dataclass(frozen=True)
class JsonValue:
    """A value of ``file`` at ``key``; each method returns it as what is expected there or raises ReconstructionError.

    ``remedy`` ends each message.
    """

    file: Path
    key: str
    value: Any
    remedy: str

    def refuse(self, expected: str) -> NoReturn:
        """Raise the error that says what was expected here and what was found."""
        found = repr(self.value)
        shown = found if len(found) <= 60 else f"{found[:57]}..."
        place = f"{self.file}: {self.key}" if self.key else f"{self.file}"
        raise ReconstructionError(f"{place}: expected {expected}, found {shown}; {self.remedy}")

    def member(self, name: str) -> "JsonValue":
        """Return the value under ``name`` of an object."""
        if not isinstance(self.value, dict):
            self.refuse("an object")
        key = f"{self.key}.{name}" if self.key else name
        if name not in self.value:
            raise ReconstructionError(f"{self.file}: {key}: missing; {self.remedy}")
        return JsonValue(self.file, key, self.value[name], self.remedy)

    def optional_number(self, name: str) -> float | None:
        """Return the finite number under ``name`` of an object, None where there is none or it is null."""
        if isinstance(self.value, dict) and self.value.get(name) is None:
            return None
        return self.member(name).number()

    def optional_member(self, name: str) -> "JsonValue | None":
        """Return the value under ``name`` of an object, None where there is none or it is null."""
        if isinstance(self.value, dict) and self.value.get(name) is None:
            return None
        return self.member(name)

    def items(self) -> Iterator["JsonValue"]:
        """Yield the items of a list."""
        if not isinstance(self.value, list):
            self.refuse("a list")
        for index, item in enumerate(self.value):
            yield JsonValue(self.file, f"{self.key}[{index}]", item, self.remedy)

    def text(self) -> str:
        """Return a text that is not empty."""
        if not isinstance(self.value, str) or not self.value:
            self.refuse("a text")
        return self.value

    def integer(self, *, at_least: int = 0) -> int:
        """Return an integer that Blender can keep (32 bits)."""
        if type(self.value) is not int or not at_least <= self.value < 2**31:
            self.refuse(f"an integer of {at_least} or more")
        return self.value

    def number(self) -> float:
        """Return a finite number."""
        if type(self.value) not in (int, float) or not math.isfinite(self.value):
            self.refuse("a finite number")
        return float(self.value)

    def positive_number(self) -> float:
        """Return a finite number above zero."""
        number = self.number()
        if number <= 0:
            self.refuse("a number above 0")
        return number

    def pose(self) -> NDArray[np.float64]:
        """Return a rigid 4×4 matrix."""
        try:
            matrix = np.array(self.value, dtype=np.float64)
        except (TypeError, ValueError):
            self.refuse("a 4×4 matrix of numbers")
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            self.refuse("a 4×4 matrix of finite numbers")
        rotation = matrix[:3, :3]
        departure = np.abs(rotation.T @ rotation - np.eye(3)).max()
        is_affine = np.abs(matrix[3] - (0, 0, 0, 1)).max() <= 1e-6
        if departure > RIGID_TOLERANCE or np.linalg.det(rotation) < 0 or not is_affine:
            self.refuse("a rigid transform (a rotation and a translation, last row 0 0 0 1)")
        return matrix


def is_there(path: Path) -> bool:
    """Tell whether a file or a folder is there; raises ReconstructionError where that may not be known."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:
        raise unreadable(path, error) from error
    return True


def unreadable(path: Path, error: OSError) -> ReconstructionError:
    """Return the error for what is there but cannot be read."""
    reason = error.strerror or error
    return ReconstructionError(f"{path}: cannot be read ({reason}); change its permissions, or choose another folder")


def read_json(file: Path, *, remedy: str) -> JsonValue:
    """Return the whole value of a JSON file; raises ReconstructionError where it is missing or damaged."""
    try:
        value = json.loads(file.read_bytes())
    except FileNotFoundError:
        raise ReconstructionError(f"{file}: the file is missing; {remedy}") from None
    except OSError as error:
        raise unreadable(file, error) from error
    except (ValueError, RecursionError) as error:
        raise ReconstructionError(f"{file}: damaged, not JSON ({error}); {remedy}") from error
    return JsonValue(file, "", value, remedy)
