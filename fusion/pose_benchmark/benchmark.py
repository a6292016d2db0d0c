"""The benchmark: subjects made, cases run or read, table and pictures written."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from datagen.atomic_write import remove_unfinished, require_writable, write_bytes, write_json
from datagen.errors import InputError
from datagen.frame_selection import select_frames
from datagen.open_dataset import open_dataset
from datagen.progress import ProgressReporter, silent
from fusion.devices import Device, resolve_device
from fusion.pose_benchmark.case_files import CaseResult, case_file, errors_as_json, read_case, write_case
from fusion.pose_benchmark.histograms import error_histograms
from fusion.pose_benchmark.object_box import ObjectBox
from fusion.pose_benchmark.overlays import Overlay, overlays
from fusion.pose_benchmark.page import Section, render_page
from fusion.pose_benchmark.protocol import Trial, trials_for
from fusion.pose_benchmark.run_case import run_case
from fusion.pose_benchmark.scanned_subject import scanned_subject
from fusion.pose_benchmark.subjects import Kind, Subject
from fusion.pose_benchmark.summary import Row, as_markdown, rows_as_json, summarize
from fusion.pose_benchmark.tasks import Case
from fusion.pose_benchmark.ycb_video import is_ycb_video, ycb_video_subjects
from fusion.reconstruction_files import installed_versions
from fusion.report.page import encode_png

MODELS_FOLDER, CASES_FOLDER, PICTURES_FOLDER = "models", "cases", "pictures"
PAGE_FILE, TABLE_FILE, RESULTS_FILE = "pose-benchmark.html", "table.md", "results.json"


@dataclass(frozen=True, kw_only=True)
class BenchmarkConfig:
    """What to run.

    ``protocol`` is the kind of all datasets, None to tell it from each. ``fuse`` takes the frames that are fused,
    ``frames`` those of the others that are located: START:STOP:STEP, None for the protocol's own. ``trials`` are names
    of trials, None for all. ``box`` is where the object is, where datasets show more.
    """

    protocol: Kind | None = None
    trials: tuple[str, ...] | None = None
    fuse: str | None = None
    frames: str | None = None
    voxel_size: float | None = None
    box: ObjectBox | None = None
    seed: int = 0
    device: str = "auto"


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The table's rows, all cases, and the page that shows them."""

    rows: tuple[Row, ...]
    cases: tuple[CaseResult, ...]
    page: Path


def run_benchmark(
    folders: Sequence[Path], out: Path, config: BenchmarkConfig, *, progress: ProgressReporter = silent
) -> Outcome:
    """Run the protocol on datasets, or folders of YCB-Video's frames, and write table, page and pictures into ``out``.

    Fused models and the results of cases are kept there and not made again by a second call, so that an interrupted one
    goes on. Raises InputError for folders that cannot be used and for a choice of trials that leaves none.
    """
    require_writable(out)
    device = resolve_device(config.device)
    sections: list[Section] = []
    rows: list[Row] = []
    cases: list[CaseResult] = []
    names: set[str] = set()
    for folder in folders:
        for subject in _subjects(folder, out, config, device, progress):
            if subject.name in names:
                raise InputError(f"two subjects are called {subject.name!r}; rename a folder")
            names.add(subject.name)
            section, done = _section(subject, out, config, progress)
            if section is not None:
                sections.append(section)
                rows += section.rows
                cases += done
    if not sections:
        raise InputError(f"--trials {','.join(config.trials or ())}: no dataset has any of these trials")
    return _write(out, config, sections, rows, cases)


def _subjects(
    folder: Path, out: Path, config: BenchmarkConfig, device: Device, progress: ProgressReporter
) -> list[Subject]:
    if config.protocol == "points" or (config.protocol is None and is_ycb_video(folder)):
        return ycb_video_subjects(folder, voxel_size=config.voxel_size, device=device)
    dataset = open_dataset(folder)
    # A true mesh comes with what was rendered; a recording without one is taken for a room.
    kind: Kind = config.protocol or ("room" if dataset.ground_truth_mesh is None else "object")
    subject = scanned_subject(
        dataset,
        out / MODELS_FOLDER / folder.resolve().name,
        kind=kind,
        fuse=config.fuse,
        voxel_size=config.voxel_size,
        box=config.box,
        device=device,
        progress=progress,
    )
    return [subject]


def _section(
    subject: Subject, out: Path, config: BenchmarkConfig, progress: ProgressReporter
) -> tuple[Section | None, list[CaseResult]]:
    """Run a subject's trials, and make its part of the page; None where none of them was chosen."""
    width = subject.view(subject.queries[0]).camera.width
    trials = trials_for(subject, config.trials, width_px=width)
    if not trials:
        return None, []
    frames = select_frames(subject.queries, config.frames)
    done = [(trial, _run_trial(subject, trial, frames, out, config, progress)) for trial in trials]
    advance = progress("pictures", len(trials))
    pictures: list[tuple[str, Overlay]] = []
    for trial, results in done:
        pictures += [(trial.title, one) for one in overlays(subject, trial, results, seed=config.seed)]
        advance()
    section = Section(
        name=subject.name,
        description=_description(subject, frames),
        rows=tuple(row for trial, results in done for row in summarize(subject, trial, results)),
        histograms=error_histograms(done),
        overlays=tuple(pictures),
    )
    _write_pictures(out / PICTURES_FOLDER / subject.name, section)
    return section, [result for _trial, results in done for result in results]


def _run_trial(
    subject: Subject,
    trial: Trial,
    frames: tuple[int, ...],
    out: Path,
    config: BenchmarkConfig,
    progress: ProgressReporter,
) -> list[CaseResult]:
    """Run the cases that are not there yet, in order, and return all."""
    cases = [
        Case(subject=subject, trial=trial, frame=frame, repeat=repeat, seed=config.seed)
        for frame in frames
        for repeat in range(trial.repeats)
    ]
    advance = progress(f"{subject.name} {trial.name}", len(cases))
    results = []
    is_warm = False
    for case in cases:
        path = case_file(out / CASES_FOLDER, subject.name, trial.name, case.frame, case.repeat)
        result = read_case(path, identity=case.identity)
        if result is None:
            if not is_warm:
                run_case(case)  # compiles kernels, fills caches: its time is not told
                is_warm = True
            result = run_case(case)
            write_case(path, result)
        results.append(result)
        advance()
    return results


def _description(subject: Subject, frames: tuple[int, ...]) -> str:
    model = subject.model
    origin = "made of points" if subject.fused is None else f"fused from {len(subject.fused.poses)} frames"
    return (
        f"A model {origin}, voxels of {1000 * model.voxel_size:.3g} mm, {subject.points.diameter:.3g} m across; "
        f"{len(frames)} frames to locate in it."
    )


def _write_pictures(folder: Path, section: Section) -> None:
    write_bytes(folder / "histograms.png", section.histograms)
    for _title, overlay in section.overlays:
        write_bytes(folder / f"{overlay.case.trial}-{overlay.which}.png", encode_png(overlay.image))


def _write(
    out: Path, config: BenchmarkConfig, sections: list[Section], rows: list[Row], cases: list[CaseResult]
) -> Outcome:
    facts = [("seed", str(config.seed)), *installed_versions().items()]
    remove_unfinished(out)
    write_bytes(out / TABLE_FILE, as_markdown(rows).encode())
    write_json(out / RESULTS_FILE, {"facts": dict(facts), "rows": rows_as_json(rows), "cases": errors_as_json(cases)})
    write_bytes(out / PAGE_FILE, render_page(sections, facts=facts).encode())
    return Outcome(rows=tuple(rows), cases=tuple(cases), page=out / PAGE_FILE)
