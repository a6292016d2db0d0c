"""What Blender says about a model file, asked in a process of its own."""

import json
import math
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.blender_program import module_command, module_environment
from datagen.errors import InputError, WorkerError

MEASURING_MODULE = "datagen.blender.measure"


@dataclass(frozen=True, kw_only=True)
class MeasuredModel:
    """How large a model is and what it brings.

    ``low`` and ``high`` are the corners of its bounding box, z up, in its units of ``metres_per_unit``, as all lengths
    here. ``is_lit`` tells whether a .blend has lights or a world that shines; ``camera`` has the settings of its camera
    for a scene file, with ``frames``, ``size``, ``frames_per_second`` and ``farthest``, the largest distance to the
    bounding box along its path (None: no camera).
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    is_lit: bool
    camera: dict[str, Any] | None
    metres_per_unit: float

    @property
    def center(self) -> tuple[float, float, float]:
        """The middle of the bounding box."""
        x, y, z = ((a + b) / 2 for a, b in zip(self.low, self.high, strict=True))
        return (x, y, z)

    @property
    def radius(self) -> float:
        """Half the bounding box's diagonal."""
        return math.dist(self.low, self.high) / 2


def measure_model(path: Path) -> MeasuredModel:
    """Ask Blender about a model file. Raises InputError where it cannot be used or Blender is not installed."""
    with tempfile.TemporaryDirectory(prefix="scanback-measure-") as folder:
        done = subprocess.run(  # noqa: S603 - our own module
            module_command(MEASURING_MODULE, str(path)),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            env=module_environment(Path(folder)),
            check=False,
        )
    try:
        answer = json.loads(done.stdout[done.stdout.find("{") :])
    except ValueError:
        raise WorkerError(
            f"{path}: Blender ended with exit code {done.returncode} while it read the file. "
            f"The last it printed:\n{done.stderr[-2000:].strip() or '(nothing)'}"
        ) from None
    if "error" in answer:
        raise InputError(answer["error"])
    low, high = tuple(answer["low"]), tuple(answer["high"])
    return MeasuredModel(
        low=low,
        high=high,
        is_lit=answer["is_lit"],
        camera=answer["camera"],
        metres_per_unit=answer["metres_per_unit"],
    )
