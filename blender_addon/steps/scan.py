"""The first step: what is in the scene, rendered into a dataset."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import ReconstructionError
from ..jobs.command import Command
from ..jobs.job import Job, Work
from ..preferences import render_device
from ..settings import DATASET, SOURCE
from .estimate import estimate_command, note_estimate
from .scan_source import write_source
from .status import forget

ORDER_FILE = "scan.json"
"""Beside the scene file: how it is rendered, so that a scan can be gone on with as it was begun."""


@dataclass(frozen=True, kw_only=True)
class ScanOrder:
    """A scan that is all prepared: its folder, and what is said to the command that renders it."""

    folder: Path
    preset: str
    sensor: str
    frames: int

    @property
    def dataset(self) -> Path:
        """Where the frames go."""
        return self.folder / DATASET


def prepare_scan(scene: Any, active: Any, folder: Path, settings: dict[str, Any], *, overwrite: bool) -> ScanOrder:
    """Write what is to be scanned into ``folder``. Raises ReconstructionError where there is a dataset to be kept."""
    dataset = folder / DATASET
    if dataset.exists():
        if not overwrite:
            raise ReconstructionError(
                f"{dataset}: holds a scan already; go on with it, scan again in its place, or choose another folder"
            )
        _remove_own(folder)
    scene_file = write_source(scene, active, folder / SOURCE, settings)
    order = ScanOrder(folder=folder, preset=settings["preset"], sensor=settings["sensor"], frames=settings["frames"])
    content = {"preset": order.preset, "sensor": order.sensor, "frames": order.frames}
    scene_file.with_name(ORDER_FILE).write_text(json.dumps(content), encoding="utf-8")
    forget()
    return order


def begun_scan(folder: Path) -> ScanOrder:
    """Return the scan that was begun in ``folder``. Raises ReconstructionError where none was."""
    file = folder / SOURCE / ORDER_FILE
    try:
        content = json.loads(file.read_bytes())
        return ScanOrder(
            folder=folder,
            preset=str(content["preset"]),
            sensor=str(content["sensor"]),
            frames=int(content["frames"]),
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ReconstructionError(f"{folder}: no scan was begun here; scan first") from error


def scan_work(order: ScanOrder) -> Callable[[Job], Work[str]]:
    """Return the job that renders what was prepared, or the rest of it."""

    def work(job: Job) -> Work[str]:
        scene_file = order.folder / SOURCE / "scan.toml"
        options = ("--preset", order.preset, "--device", render_device())
        arguments: tuple[str, ...] = ("render", str(scene_file), str(order.dataset), *options)
        yield from job.run(Command(program="datagen", arguments=arguments, failure="The scan stopped"))
        forget()
        if order.sensor != "NONE":
            arguments = ("sensor", str(order.dataset), "--model", order.sensor)
            yield from job.run(Command(program="datagen", arguments=arguments, failure="The sensor was not simulated"))
            forget()
        note_estimate(order.dataset, (yield from job.run(estimate_command(order.dataset))))
        return f"Scanned {order.frames} frames into {order.dataset}"

    return work


def _remove_own(folder: Path) -> None:
    """Remove an earlier scan of ours: what else may lie in the folder stays."""
    begun_scan(folder)  # else the dataset is somebody else's
    try:
        shutil.rmtree(folder / DATASET)
    except OSError as error:
        raise ReconstructionError(f"{error.filename}: cannot be removed ({error.strerror})") from error
