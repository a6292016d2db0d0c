"""Proof that a dataset's frames are what its recipe renders: some are rendered again and compared."""

import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from datagen.dataset import read_pose
from datagen.dataset_format import METADATA_FILE, Metadata, read_metadata
from datagen.errors import InputError
from datagen.progress import ProgressReporter, silent
from datagen.rendering.crew import render_workers
from datagen.rendering.frame_files import damaged_file, frame_files, is_complete
from datagen.rendering.provenance import metadata_of
from datagen.rendering.render_workers import Job, Task
from datagen.scene_spec.model_files import locate_models
from datagen.scene_spec.scene import Scene

MAKER = ("blender_build", "device", "device_name")
"""Where these are the same, a frame must be so to the last bit."""
MEAN_COLOR_STEPS = 0.5
"""How far the colours of other makers may be apart, on average: sampling noise is the same but for rounding."""
LARGEST_STEP = 1
ODD_PIXELS = 1e-4
"""Share of other images' pixels that may differ by more than a step: at edges rounding decides what is seen."""
POSE_TOLERANCE = 1e-6


@dataclass(frozen=True, kw_only=True)
class FrameVerdict:
    """What was found wrong with a frame; nothing where it is what the recipe renders."""

    frame: int
    faults: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Verification:
    """The verdict on each frame that was rendered again, and whether by the same version on the same device."""

    verdicts: tuple[FrameVerdict, ...]
    same_maker: bool

    @property
    def passed(self) -> bool:
        """Whether no frame has a fault."""
        return not any(verdict.faults for verdict in self.verdicts)


def verify_dataset(
    folder: Path,
    *,
    frames: int,
    rng: np.random.Generator,
    models: Path = Path(),
    device: str = "auto",
    workers: int = 1,
    progress: ProgressReporter = silent,
    tell: Callable[[str], None] = lambda _: None,
) -> Verification:
    """Render ``frames`` of a dataset's frames, drawn by ``rng``, again and compare all of their files.

    By the same version of Blender on the same device every image must be the same; otherwise colours may differ by
    ``MEAN_COLOR_STEPS`` on average, other images by a step but for ``ODD_PIXELS``, poses by ``POSE_TOLERANCE``. Model
    files that the recipe names are looked for in ``models`` and told by their SHA-256. Raises InputError where the
    dataset was not rendered by us, lacks its models or has no whole frame, WorkerError where Blender fails.
    """
    metadata = read_metadata(folder)
    scene = _scene_of(folder, metadata, models)
    whole = [i for i in range(metadata.frame_count) if is_complete(frame_files(folder, metadata.layers, i))]
    if not whole:
        raise InputError(f"{folder}: has no frame of which all files are there; render it first")
    chosen = sorted(rng.choice(whole, size=min(frames, len(whole)), replace=False).tolist())
    tasks = [Task(kind="frame", frame=frame) for frame in chosen]
    advance = progress("Verifying", len(tasks))
    verdicts: list[FrameVerdict] = []
    same_maker, rendered = False, metadata.layers
    with tempfile.TemporaryDirectory(prefix="scanback-verify-") as name:
        again = Path(name)
        job = Job(scene=scene, folder=again, device=device)
        with render_workers(job, tasks, workers=workers, tell=tell) as reports:
            for report in reports:
                if report.task is None:
                    now = metadata_of(scene, report.content)
                    same_maker = _is_same_maker(folder, metadata, now)
                    # What was made of the images afterwards, as by a sensor, is not rendered again.
                    rendered = tuple(layer for layer in metadata.layers if layer in now.layers)
                    continue
                frame = report.task.frame
                files = frame_files(folder, rendered, frame)
                faults = _faults(files, frame_files(again, rendered, frame), exact=same_maker)
                verdicts.append(FrameVerdict(frame=frame, faults=tuple(faults)))
                advance()
    return Verification(verdicts=tuple(sorted(verdicts, key=lambda verdict: verdict.frame)), same_maker=same_maker)


def _scene_of(folder: Path, metadata: Metadata, models: Path) -> Scene:
    try:
        return Scene.model_validate_json(json.dumps(locate_models(metadata.recipe, models)))
    except ValidationError as error:
        raise InputError(
            f"{folder / METADATA_FILE}: its recipe is not that of a scene ({error.error_count()} faults), so it cannot "
            "be rendered again; only datasets that datagen render made can be verified"
        ) from error


def _is_same_maker(folder: Path, there: Metadata, now: Metadata) -> bool:
    for key, value in now.intrinsics.model_dump().items():
        stored = getattr(there.intrinsics, key)
        if abs(value - stored) > 1e-4:
            raise InputError(f"{folder / METADATA_FILE}: intrinsics.{key} is {stored}, the recipe gives {value}")
    return all(there.provenance.get(key) == now.provenance.get(key) for key in MAKER)


def _faults(files: Sequence[Path], again: Sequence[Path], *, exact: bool) -> list[str]:
    damaged = damaged_file(tuple(files))
    if damaged is not None:
        return [f"{damaged.name} is damaged"]
    pairs = zip(files, again, strict=True)
    return [f"{file.name}: {fault}" for file, other in pairs if (fault := _difference(file, other, exact=exact))]


def _difference(file: Path, again: Path, *, exact: bool) -> str | None:
    """Say how two files of a frame differ beyond what may be, None if they do not."""
    if file.suffix == ".txt":
        apart = float(np.abs(read_pose(file) - read_pose(again)).max())
        return f"the pose is up to {apart:.2g} off" if apart > (0 if exact else POSE_TOLERANCE) else None
    there, wanted = _values(file), _values(again)
    if there.shape != wanted.shape:
        return f"is {there.shape}, rendered again {wanted.shape}"
    steps = np.abs(there - wanted)
    steps[np.isnan(there) & np.isnan(wanted)] = 0
    steps[np.isnan(there) != np.isnan(wanted)] = np.inf
    different = float(np.mean(steps > 0))
    said = (
        f"{different:.2%} of its values differ, by up to {steps.max():g} {'px' if file.suffix == '.flo' else 'steps'}"
    )
    if exact:
        return said if different else None
    if file.name.endswith("color.png"):
        return said if steps.mean() > MEAN_COLOR_STEPS else None
    return said if np.mean(steps > LARGEST_STEP) > ODD_PIXELS else None


def _values(path: Path) -> NDArray[np.float64]:
    if path.suffix == ".flo":
        return np.asarray(cv2.readOpticalFlow(str(path)), dtype=np.float64)
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return np.asarray(image, dtype=np.float64)
