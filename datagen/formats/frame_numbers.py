"""Numbers of frames, from file names that count."""

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import PurePath

_LAST_NUMBER = re.compile(r"(\d+)\D*$")


def natural_order(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts names by their letters and, where they have digits, by the numbers: 2 before 10."""
    pieces = re.split(r"(\d+)", name)
    return [(int(piece), "") if piece.isdecimal() else (-1, piece) for piece in pieces if piece]


def frame_numbers(names: Sequence[str]) -> list[int]:
    """Return a frame number for each of the files ``names``, which are in order.

    It is the last number in the file's name where these rise from name to name (``frame-000005.color.png``: 5), else
    the position in the sequence.
    """
    found = [_LAST_NUMBER.search(PurePath(name).name.split(".")[0]) for name in names]
    numbers = [int(match[1]) for match in found if match is not None and len(match[1]) <= 9]
    rising = all(low < high for low, high in pairwise(numbers))
    return numbers if len(numbers) == len(names) and rising else list(range(len(names)))
