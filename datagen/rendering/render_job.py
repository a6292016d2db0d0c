"""Rendering a scene into a dataset folder, or the rest of it where a part is there already."""

import os
from collections.abc import Callable
from pathlib import Path

from datagen.atomic_write import TEMPORARY_PREFIX, remove_unfinished
from datagen.dataset import Dataset
from datagen.dataset_format import FRAMES_FOLDER, GROUND_TRUTH_FILE, METADATA_FILE, read_metadata
from datagen.errors import InputError
from datagen.open_dataset import open_dataset
from datagen.progress import ProgressReporter, silent
from datagen.rendering.crew import render_workers
from datagen.rendering.folder_lock import LOCK_FILE, Claim, claiming
from datagen.rendering.frame_files import damaged_file, frame_files, is_complete
from datagen.rendering.provenance import settle_metadata
from datagen.rendering.recipes import first_difference, recipe_of, with_defaults
from datagen.rendering.render_workers import FRAMES_PER_WORKER, Job, Task
from datagen.rendering.scratch import remove_abandoned_scratch
from datagen.rendering.shards import Shard
from datagen.scene_spec.scene import Scene
from datagen.scene_spec.scene_layers import layers_of

DEVICES = ("auto", "cpu", "optix", "cuda", "hip", "metal", "oneapi")
WHOLE = Shard()


def render_dataset(
    scene: Scene,
    folder: Path,
    *,
    device: str = "auto",
    require_gpu: bool = False,
    workers: int = 1,
    frames_per_worker: int = FRAMES_PER_WORKER,
    shard: Shard = WHOLE,
    progress: ProgressReporter = silent,
    tell: Callable[[str], None] = lambda _: None,
) -> Dataset:
    """Render ``scene``, or the frames of one ``shard``, into ``folder`` in worker processes and return the dataset.

    Where the folder holds a part of the same dataset, only what is missing or damaged is rendered; where it holds all,
    Blender is not started. ``tell`` gets a sentence for each mishap that was overcome. Raises InputError where the
    folder holds anything else, where another process renders these frames into it, where the device is not there or
    Blender is not installed, and WorkerError where Blender fails twice at a frame; finished frames stay.
    """
    folder = folder.resolve()
    frames = shard.frames(scene.render.frames)
    _require_own_folder(folder, scene)
    remove_abandoned_scratch()
    tasks = _missing(folder, scene, frames, tell)
    if not tasks:
        return open_dataset(folder)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    job = Job(
        scene=scene,
        folder=folder,
        device=device,
        threads=max(1, cores // workers) if workers > 1 else 0,
        require_gpu=require_gpu,
        frames_per_worker=frames_per_worker,
    )
    with claiming(folder, frames) as claim:
        _remove_leftovers(folder, scene, claim)
        _give_up_damaged(folder, scene, tasks)
        advance = progress("Rendering", sum(task.kind == "frame" for task in tasks))
        try:
            with render_workers(job, tasks, workers=workers, tell=tell) as reports:
                for report in reports:
                    if report.task is None:
                        settle_metadata(folder, scene, report.content)
                    elif report.task.kind == "frame":
                        advance()
        finally:
            _remove_leftovers(folder, scene, claim)
    return open_dataset(folder)


def _require_own_folder(folder: Path, scene: Scene) -> None:
    """Raise InputError unless the folder is free to write, or holds a dataset of the same recipe."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: a file, not a folder; name a new or empty folder for the dataset")
    if (folder / METADATA_FILE).is_file():
        existing = read_metadata(folder)
        difference = first_difference(with_defaults(existing.recipe), recipe_of(scene))
        if difference is not None:
            key, there, wanted = difference
            raise InputError(
                f"{folder}: holds a dataset of another recipe: its {key} is {there!r}, now asked for is {wanted!r}; "
                "name another folder, or delete this one to render anew"
            )
    elif folder.is_dir():
        ours = (TEMPORARY_PREFIX, LOCK_FILE)
        foreign = sorted(path.name for path in folder.iterdir() if not path.name.startswith(ours))
        if foreign:
            raise InputError(
                f"{folder}: holds files that are no dataset of ours ({', '.join(foreign[:3])}); "
                "name a new or empty folder"
            )


def _missing(folder: Path, scene: Scene, frames: range, tell: Callable[[str], None]) -> list[Task]:
    """Return what is still to do, in order."""
    if not (folder / METADATA_FILE).is_file():
        return [Task(kind="ground_truth"), *(Task(kind="frame", frame=i) for i in frames)]
    tasks = [] if (folder / GROUND_TRUTH_FILE).is_file() else [Task(kind="ground_truth")]
    for frame in frames:
        files = frame_files(folder, layers_of(scene), frame)
        if not is_complete(files):
            tasks.append(Task(kind="frame", frame=frame))
        elif (damaged := damaged_file(files)) is not None:
            tell(f"{damaged}: damaged; frame {frame} is rendered again")
            tasks.append(Task(kind="frame", frame=frame))
    return tasks


def _give_up_damaged(folder: Path, scene: Scene, tasks: list[Task]) -> None:
    """Take their pose from the frames that are rendered anew, so that readers do not take them for whole meanwhile."""
    for task in tasks:
        if task.kind == "frame":
            frame_files(folder, layers_of(scene), task.frame)[-1].unlink(missing_ok=True)


def _remove_leftovers(folder: Path, scene: Scene, claim: Claim) -> None:
    """Delete unfinished files, unless they may be those of another process that renders into the folder."""
    with claim.alone() as alone:
        if not alone:
            return
        places = (folder, folder / FRAMES_FOLDER, (folder / GROUND_TRUTH_FILE).parent)
        for place in (*places, *(folder / name for name in layers_of(scene))):
            remove_unfinished(place)
