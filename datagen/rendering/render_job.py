"""Rendering a scene into a dataset folder, or the rest of it where a part is there already."""

import json
import os
import platform
from importlib import metadata as package_metadata
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from datagen.atomic_write import TEMPORARY_PREFIX, remove_unfinished
from datagen.dataset import Dataset
from datagen.dataset_format import (
    FRAMES_FOLDER,
    GROUND_TRUTH_FILE,
    METADATA_FILE,
    Intrinsics,
    Metadata,
    read_metadata,
    write_metadata,
)
from datagen.errors import InputError
from datagen.open_dataset import open_dataset
from datagen.progress import ProgressReporter, silent
from datagen.rendering.render_workers import Job, Report, Task, render_workers
from datagen.scene_spec.scene import Scene
from datagen.sensors.extra_layers import distortion_of, sensor_of

DEVICES = ("auto", "cpu", "optix", "cuda", "hip", "metal", "oneapi")
IRRELEVANT_TO_FRAMES = {"description"}


def render_dataset(
    scene: Scene, folder: Path, *, device: str = "auto", workers: int = 1, progress: ProgressReporter = silent
) -> Dataset:
    """Render ``scene`` into ``folder`` in worker processes and return the dataset.

    Where the folder holds a part of the same dataset, only what is missing is rendered; where it holds all, Blender is
    not started. Raises InputError where it holds anything else, where the device is not there or Blender is not
    installed, and WorkerError where Blender fails; finished frames stay.
    """
    folder = folder.resolve()
    _require_own_folder(folder, scene)
    _remove_leftovers(folder)
    tasks = _missing(folder, scene)
    if not tasks:
        return open_dataset(folder)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    job = Job(scene=scene, folder=folder, device=device, threads=max(1, cores // workers) if workers > 1 else 0)
    advance = progress("Rendering", sum(task.kind == "frame" for task in tasks))
    try:
        with render_workers(job, tasks, workers=workers) as reports:
            for report in reports:
                if report.task is None:
                    _settle_metadata(folder, scene, report)
                elif report.task.kind == "frame":
                    advance()
    finally:
        _remove_leftovers(folder)
    return open_dataset(folder)


def recipe_of(scene: Scene) -> dict[str, Any]:
    """Return all that decides what a dataset's frames show, ready for JSON."""
    return scene.model_dump(mode="json", exclude=IRRELEVANT_TO_FRAMES)


def _require_own_folder(folder: Path, scene: Scene) -> None:
    """Raise InputError unless the folder is free to write, or holds a dataset of the same recipe."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: a file, not a folder; name a new or empty folder for the dataset")
    if (folder / METADATA_FILE).is_file():
        existing = read_metadata(folder)
        difference = _first_difference(_with_defaults(existing.recipe), recipe_of(scene))
        if difference is not None:
            key, there, wanted = difference
            raise InputError(
                f"{folder}: holds a dataset of another recipe: its {key} is {there!r}, now asked for is {wanted!r}; "
                "name another folder, or delete this one to render anew"
            )
    elif folder.is_dir():
        foreign = sorted(path.name for path in folder.iterdir() if not path.name.startswith(TEMPORARY_PREFIX))
        if foreign:
            raise InputError(
                f"{folder}: holds files that are no dataset of ours ({', '.join(foreign[:3])}); "
                "name a new or empty folder"
            )


def _with_defaults(recipe: dict[str, Any]) -> dict[str, Any]:
    """Return a stored recipe with the settings that came into being after it, where it is one of ours at all."""
    try:
        return recipe_of(Scene.model_validate_json(json.dumps(recipe)))
    except ValidationError:
        return recipe


def _first_difference(there: Any, wanted: Any, key: str = "") -> tuple[str, Any, Any] | None:
    """Return the key at which two recipes first differ, and what each has there (None: nothing)."""
    if isinstance(there, dict) and isinstance(wanted, dict):
        pairs = [(f"{key}.{name}".lstrip("."), name) for name in dict.fromkeys([*wanted, *there])]
        found = (_first_difference(there.get(name), wanted.get(name), path) for path, name in pairs)
    elif isinstance(there, list) and isinstance(wanted, list) and len(there) == len(wanted):
        found = (_first_difference(a, b, f"{key}[{i}]") for i, (a, b) in enumerate(zip(there, wanted, strict=True)))
    else:
        return None if there == wanted else (key, there, wanted)
    return next((difference for difference in found if difference is not None), None)


def _missing(folder: Path, scene: Scene) -> list[Task]:
    """Return what is still to do, in order."""
    frames = range(scene.render.frames)
    if not (folder / METADATA_FILE).is_file():
        return [Task(kind="ground_truth"), *(Task(kind="frame", frame=i) for i in frames)]
    dataset = open_dataset(folder)
    tasks = [Task(kind="frame", frame=i) for i in frames if not dataset.is_complete(i)]
    return tasks if (folder / GROUND_TRUTH_FILE).is_file() else [Task(kind="ground_truth"), *tasks]


def _settle_metadata(folder: Path, scene: Scene, report: Report) -> None:
    """Write ``dataset.json``, or check that what begins to render now is what rendered the frames that are there."""
    provenance = {
        "program": f"scanback {_version()}",
        **report.content["provenance"],
        "platform": platform.platform(),
        "python": platform.python_version(),
    }
    intrinsics = Intrinsics(**report.content["intrinsics"])
    metadata = Metadata(
        frame_count=scene.render.frames,
        intrinsics=intrinsics,
        depth_scale=scene.render.depth_scale,
        frames_per_second=scene.render.frames_per_second,
        ground_truth_mesh=GROUND_TRUTH_FILE,
        sensor=sensor_of(scene),
        distortion=distortion_of(intrinsics.camera, scene.lens) if scene.lens is not None else None,
        recipe=recipe_of(scene),
        provenance=provenance,
    )
    if not (folder / METADATA_FILE).is_file():
        write_metadata(folder, metadata)
        return
    begun = read_metadata(folder)
    for key in ("blender", "device"):
        before, now = begun.provenance.get(key), provenance[key]
        if before != now:
            raise InputError(
                f"{folder}: its frames were rendered with {key} {before}, this would go on with {now}, and they would "
                f"not match; use {before} again, or another folder"
            )
    if begun.intrinsics != metadata.intrinsics:
        raise InputError(f"{folder}: its camera is {begun.intrinsics}, Blender now has {metadata.intrinsics}")


def _version() -> str:
    try:
        return package_metadata.version("scanback")
    except package_metadata.PackageNotFoundError:
        return "(source checkout)"


def _remove_leftovers(folder: Path) -> None:
    for place in (folder, folder / FRAMES_FOLDER, (folder / GROUND_TRUTH_FILE).parent):
        remove_unfinished(place)
