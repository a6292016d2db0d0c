"""JSON files of other programs: read whole, and asked for values that are checked."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.errors import InputError

LARGEST_DEPTH_SCALE_M = 10.0
"""As in ``dataset.json``; with it, depth in 16 bits ends at 655 km."""


def read_json_object(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file; raises InputError naming the line where it is malformed."""
    try:
        value = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise InputError(f"{path}: the file is missing") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except json.JSONDecodeError as error:
        raise InputError(f"{path}, line {error.lineno}: not JSON ({error.msg}); copy or write the file again") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not JSON ({error})") from None
    if not isinstance(value, dict):
        raise InputError(f"{path}: holds a {type(value).__name__}, expected an object")
    return value


def numbers(value: Any, count: int, *, source: str) -> NDArray[np.float64]:
    """Return ``count`` finite numbers, whatever way ``value`` nests them; else an InputError begins with ``source``."""
    try:
        array = np.asarray(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.size != count or not np.isfinite(array).all():
        raise InputError(f"{source}: found {_short(value)}, expected {count} finite number{'s' if count > 1 else ''}")
    return array


def depth_scale(value: Any, *, unit_m: float = 1.0, source: str) -> float:
    """Return metres a step of depth images from ``value`` in units of ``unit_m``; ``source`` begins the InputError.

    It is refused where it is not more than 0 and at most ``LARGEST_DEPTH_SCALE_M``.
    """
    scale = float(numbers(value, 1, source=source)[0])
    if not 0 < scale * unit_m <= LARGEST_DEPTH_SCALE_M:
        raise InputError(
            f"{source}: found {scale:g}, expected more than 0 and at most {LARGEST_DEPTH_SCALE_M / unit_m:g}"
        )
    return scale * unit_m


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
