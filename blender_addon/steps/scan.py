"""The first step: what is in the scene, rendered into a dataset."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import ReconstructionError
from ..jobs.command import Command
from ..jobs.folder_claim import claiming, while_claimed
from ..jobs.job import Job, Work
from ..preferences import render_device
from ..results.originals import forget_deleted, note_originals
from ..scan_folder import DATASET, RECONSTRUCTION, SOURCE
from .estimate import estimate_command, note_estimate
from .scan_source import scanned, write_source
from .status import forget

ORDER_FILE = "scan.json"
"""Beside the scene file: how it is rendered, so that a scan can be gone on with as it was begun."""


@dataclass(frozen=True, kw_only=True)
class ScanOrder:
    """A scan that is all prepared: its folder, and what is said to the command that renders it.

    ``objects`` are the names of those that were there to be scanned.
    """

    folder: Path
    preset: str
    sensor: str
    frames: int
    objects: tuple[str, ...] = ()

    @property
    def dataset(self) -> Path:
        """Where the frames go."""
        return self.folder / DATASET


def prepare_scan(scene: Any, active: Any, folder: Path, settings: dict[str, Any], *, overwrite: bool) -> ScanOrder:
    """Write what is to be scanned into ``folder``, in the place of what was there.

    Raises ReconstructionError, with nothing changed, where there is a dataset to be kept, no place to write to, or
    another Blender at work.
    """
    with claiming(folder, makes=True):
        _replace_source(scene, active, folder, settings, overwrite=overwrite)
    return begun_scan(folder)


def _replace_source(scene: Any, active: Any, folder: Path, settings: dict[str, Any], *, overwrite: bool) -> None:
    dataset = folder / DATASET
    if dataset.exists():
        if not overwrite:
            raise ReconstructionError(
                f"{dataset}: holds a scan already; go on with it, scan again in its place, or choose another folder"
            )
        begun_scan(folder)  # else the dataset is somebody else's
    forget_deleted(scene)  # else they would be written with the scene
    new = folder / f"{SOURCE}.new"
    try:
        _remove(new)
        write_source(scene, active, new, settings)
        content = {name: settings[name] for name in ("preset", "sensor", "frames")}
        objects = scanned(scene, active, settings["subject"])
        content["objects"] = [item.name for item in objects]
        (new / ORDER_FILE).write_text(json.dumps(content), encoding="utf-8")
        # What there was is removed when all that takes its place could be written.
        _remove(dataset)
        _remove(folder / SOURCE)
        new.rename(folder / SOURCE)
        note_originals(scene, (folder / RECONSTRUCTION).resolve(), objects, anew=True)
    except BaseException:
        shutil.rmtree(new, ignore_errors=True)
        raise
    finally:
        forget()


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
            objects=tuple(str(name) for name in content.get("objects", ())),
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ReconstructionError(f"{folder}: no scan was begun here; scan first") from error


def scanned_objects(folder: Path) -> tuple[str, ...]:
    """Return the names of the objects that were scanned into ``folder``, none where that is not known."""
    try:
        return begun_scan(folder).objects
    except ReconstructionError:
        return ()


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

    return while_claimed(order.folder, work)


def _remove(folder: Path) -> None:
    if not folder.exists():
        return
    try:
        shutil.rmtree(folder)
    except OSError as error:
        raise ReconstructionError(f"{error.filename}: cannot be removed ({error.strerror})") from error
