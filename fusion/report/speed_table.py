"""Table I: how fast each scene is fused, beside what the paper says."""

from collections.abc import Sequence
from dataclasses import dataclass

import psutil
import warp as wp

from fusion.devices import resolve_device
from fusion.report.panels import percent, ratio
from fusion.report.runs import Run
from fusion.report.subject import Subject


@dataclass(frozen=True, kw_only=True)
class Speed:
    """A row of table I: the seconds and frames/s of finding blocks and integrating; None where the paper is silent.

    ``with_decoding`` are frames/s with the time that was spent waiting for images; ``ours`` tells us from the paper.
    """

    device: str
    frames: int
    seconds: float | None
    frames_per_second: float
    with_decoding: float | None = None
    ours: bool = False


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A scene's rows, and in ``words`` how ours compare with the paper's."""

    name: str
    rows: tuple[Speed, ...]
    words: str = ""


def _paper(name: str, seconds: float, rate: float) -> Scene:
    return Scene(
        name=name,
        rows=(
            Speed(device="the paper, its GPU", frames=500, seconds=seconds, frames_per_second=rate),
            Speed(device="the paper, its CPU", frames=500, seconds=None, frames_per_second=0.5),
        ),
    )


PAPER = {
    "bunny": _paper("Stanford Bunny", 1.68, 296.67),
    "suzanne": _paper("Suzanne", 0.45, 530.74),
    "table": _paper("Table with object", 1.68, 296.67),
}
"""Table I of the paper, and its text for the CPU, by a word that tells the scene."""

NOTE = (
    "Finding blocks and integrating distance and colour, by the wall's clock; with decoding, the waiting for images "
    "too. The paper names neither its devices nor its voxels, and 500 frames in 0.45 s would be 1,111 a second."
)


def speed_scenes(subjects: Sequence[Subject]) -> tuple[tuple[Scene, ...], str]:
    """Fuse each subject on the CPU and on the GPU if there is one; returns the table's scenes and a note on them.

    The paper's rows stand with the scene that is named as theirs is, or at the end.
    """
    scenes, loads = [], []
    left = dict(PAPER)
    devices = ["cpu", *(device.alias for device in wp.get_cuda_devices()[:1])]
    for subject in subjects:
        runs = [subject.reconstruct(device=device) for device in devices]
        loads += [run.load for run in runs if run.load is not None]
        word = next((word for word in PAPER if word in _names(subject)), None)
        paper = PAPER[word] if word is not None else None
        left.pop(word or "", None)
        ours = tuple(_row(run, device) for run, device in zip(runs, devices, strict=True))
        scenes.append(
            Scene(
                name=subject.name,
                rows=(*ours, *(paper.rows if paper else ())),
                words=_words(ours, paper) if paper else "",
            )
        )
    busiest = max(loads, default=0.0)
    cores = psutil.cpu_count() or 1
    note = NOTE
    if busiest > 1.5 * cores:
        note += (
            f" Under load: while we measured, up to {busiest:.1f} programs wanted one of the {cores} cores, so that "
            "our rates are too low."
        )
    return (*scenes, *left.values()), note


def _names(subject: Subject) -> str:
    """Return what a dataset is called, its folder and its recipe."""
    metadata = subject.dataset.metadata
    recipe = "" if metadata is None else str(metadata.recipe.get("name", ""))
    return f"{subject.name} {recipe}".lower()


def _row(run: Run, device: str) -> Speed:
    record = run.record
    name = f"ours, CPU, {psutil.cpu_count()} cores" if device == "cpu" else f"ours, {resolve_device(device).name}"
    return Speed(
        device=name,
        frames=record.frames,
        seconds=record.seconds.allocate + record.seconds.integrate,
        frames_per_second=record.frames_per_second,
        with_decoding=record.frames_per_second_with_decoding,
        ours=True,
    )


def _words(ours: Sequence[Speed], paper: Scene) -> str:
    gpu, cpu = paper.rows
    told = [
        f"{row.device.removeprefix('ours, ')}: {ratio(row.frames_per_second / cpu.frames_per_second)} times the "
        f"paper's CPU, {_against(row.frames_per_second / gpu.frames_per_second)} its GPU"
        for row in ours
    ]
    return "; ".join(told) + "."


def _against(share: float) -> str:
    return f"{ratio(share)} times" if share >= 1 else f"{percent(share)} of"
