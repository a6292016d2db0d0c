"""Lines of whitespace-separated fields with ``#`` comments, as TUM's and COLMAP's text files have them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line: its file, its number from 1, its fields."""

    path: Path
    line: int
    fields: tuple[str, ...]

    def error(self, complaint: str) -> InputError:
        """Return an error that names the file and line."""
        return InputError(f"{self.path}, line {self.line}: {complaint}")

    def require(self, count: int, expected: str) -> None:
        """Raise InputError unless the row has at least ``count`` fields; ``expected`` names them."""
        if len(self.fields) < count:
            raise self.error(f"found {len(self.fields)} fields, expected {count}: {expected}")

    def numbers(self, fields: Sequence[str], expected: str) -> NDArray[np.float64]:
        """Return some of the row's fields as finite numbers; raises InputError naming the one that is none."""
        values = np.empty(len(fields))
        for i, field in enumerate(fields):
            try:
                values[i] = float(field)
            except ValueError:
                raise self.error(f"found {field!r}, expected a number; the line reads: {expected}") from None
        if not np.isfinite(values).all():
            raise self.error(f"holds NaN or infinity; the line reads: {expected}; leave this line out")
        return values

    def integer(self, field: str, name: str) -> int:
        """Return one of the row's fields as an integer from 0; raises InputError where it is none."""
        if not field.isdecimal():
            raise self.error(f"found {field!r} as {name}, expected an integer from 0")
        return int(field)


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file; raises InputError where it is missing or no text."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: the file is missing") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text ({error})") from error
    if "\0" in text:
        raise InputError(f"{path}: holds zero bytes, as a file does whose writing was cut short; copy it again")
    return text.splitlines()


def read_rows(path: Path) -> list[Row]:
    """Return the rows of a text file but for comments and empty lines; raises InputError where it cannot be read."""
    return [
        Row(path=path, line=number, fields=tuple(line.split()))
        for number, line in enumerate(read_lines(path), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
