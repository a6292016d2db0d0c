"""The report of some datasets: reconstructions, figures, table, page."""

import platform
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import psutil

from datagen.atomic_write import require_writable, write_bytes
from datagen.dataset import Dataset
from datagen.errors import InputError
from datagen.formats.registry import FORMATS
from datagen.progress import ProgressReporter, silent
from fusion.devices import Device, load_kernels, resolve_device
from fusion.reconstruction_config import ReconstructionConfig
from fusion.reconstruction_files import installed_versions
from fusion.report import figures, mesher_figure
from fusion.report.coloured_figure import coloured
from fusion.report.page import Section, encode_png, render_page
from fusion.report.panels import Figure, Numbers, errors, millimetres
from fusion.report.speed_table import speed_scenes
from fusion.report.subject import Subject, suitable_config, truth_of, view_of
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_files import read_mesh

PAGE_FILE = "report.html"
IMAGES_FOLDER = "images"
RUNS_FOLDER = "runs"
KERNEL_MODULES = ("fusion.surface.closest_points", "fusion.surface.mesh_ray_casting")


def write_report(
    datasets: Sequence[Dataset],
    out: Path,
    config: ReconstructionConfig,
    *,
    view_frame: int | None = None,
    progress: ProgressReporter = silent,
) -> Path:
    """Write ``report.html`` and its pictures into ``out`` and return the page's path.

    Reconstructions are kept in ``out/runs`` and not made again by a second call, so that an interrupted one goes on.
    ``view_frame`` is the frame from whose pose pictures are taken, the first where None. Raises InputError, before
    anything is made, for datasets that share a name, lack a file or a true mesh that they name, and where ``out`` is a
    dataset itself; and for everything that a reconstruction refuses.
    """
    names = [dataset.folder.resolve().name for dataset in datasets]
    truths = [_checked(dataset, view_frame) for dataset in datasets]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two datasets are called {name!r}; rename a folder")
    _require_place(out)
    device = resolve_device(config.device)
    load_kernels(KERNEL_MODULES, device=device, progress=progress)
    sections, subjects = [], []
    for name, dataset, truth in zip(names, datasets, truths, strict=True):
        advance = progress(name, _steps(dataset, truth))
        subject = _subject(name, dataset, truth, out / RUNS_FOLDER / name, config, device, view_frame, advance)
        made = _figures(subject, view_frame)
        _write_images(out / IMAGES_FOLDER / name, made)
        sections.append(Section(name=name, description=_description(subject), glance=_glance(subject), figures=made))
        subjects.append(subject)
    scenes, note = speed_scenes(subjects)
    page = render_page(sections, scenes, speed_note=note, facts=_facts(device))
    write_bytes(out / PAGE_FILE, page.encode())
    return out / PAGE_FILE


def _checked(dataset: Dataset, view_frame: int | None) -> Mesh | None:
    """Return a dataset's true mesh, None for none, once all that the report reads is there: it works for minutes."""
    dataset.require(dataset.frame_ids)
    if not dataset.frame_ids:
        raise InputError(f"{dataset.folder}: has no frames; a report needs some")
    if view_frame is not None and view_frame not in dataset.frame_ids:
        first, last = dataset.frame_ids[0], dataset.frame_ids[-1]
        raise InputError(f"--view-frame {view_frame}: {dataset.folder} has no such frame; it has {first} to {last}")
    path = dataset.ground_truth_mesh
    if path is None:
        return None
    if not path.is_file():
        raise InputError(
            f"{path}: the file is missing, and the dataset names it as its true mesh; put it there, or make the "
            'dataset.json say "ground_truth_mesh": null for a report without errors'
        )
    return read_mesh(path)


def _require_place(out: Path) -> None:
    """Refuse to write into a dataset, as happens where the last argument is forgotten."""
    if out.is_dir() and any(dataset_format.detect(out) for dataset_format in FORMATS):
        raise InputError(f"{out}: is a dataset; name the folder for the report after the datasets")
    require_writable(out)


def _subject(
    name: str,
    dataset: Dataset,
    truth: Mesh | None,
    folder: Path,
    config: ReconstructionConfig,
    device: Device,
    view_frame: int | None,
    advance: Callable[[], None],
) -> Subject:
    base = suitable_config(dataset, replace(config, device=device.alias))
    return Subject(
        name=name,
        dataset=dataset,
        truth=truth_of(dataset, truth, depth_max=config.depth_max, device=device),
        folder=folder,
        base=base,
        view=view_of(dataset, dataset.frame_ids[0] if view_frame is None else view_frame),
        device=device,
        advance=advance,
    )


def _steps(dataset: Dataset, truth: Mesh | None) -> int:
    """Return how often ``_figures`` advances."""
    if truth is None:
        return 1
    counts = (figures.frame_counts(len(dataset.frame_ids)), figures.VOXEL_FACTORS, figures.TRUNCATION_VOXELS)
    return 1 + mesher_figure.RUNS + sum(len(cases) for cases in counts)


def _figures(subject: Subject, view_frame: int | None) -> tuple[Figure, ...]:
    """Make a dataset's figures: of a recording without a true mesh the coloured mesh alone, as in the paper."""
    if subject.truth is None:
        return (coloured(subject),)
    # First what needs the volumes, which are not kept.
    meshed = mesher_figure.meshers(subject)
    grown = subject if view_frame is not None else subject.seen_from(figures.growth_view(subject))
    return (
        figures.growth(grown),
        coloured(subject),
        figures.voxel_sizes(subject),
        figures.truncations(subject),
        meshed,
    )


def _write_images(folder: Path, made: Sequence[Figure]) -> None:
    for picture in (picture for figure in made for panel in figure.panels for picture in panel.pictures):
        write_bytes(folder / f"{picture.name}.png", encode_png(picture.image))


def _glance(subject: Subject) -> Numbers:
    """Return the dataset's row in the page's first table."""
    record = subject.reconstruct().record
    numbers = (
        ("frames", f"{record.frames}"),
        ("voxel", millimetres(record.voxel_size_m)),
        ("vertices", f"{record.vertices:,}"),
    )
    rate = (("fused, frames/s", f"{record.frames_per_second:,.0f}"),)
    return (*numbers, *(() if record.metrics is None else errors(record.metrics)[:1]), *rate)


def _description(subject: Subject) -> str:
    camera, base = subject.dataset.camera, subject.base
    assert base.truncation is not None
    truth = "with a true mesh" if subject.truth is not None else "without a true mesh, so that errors cannot be told"
    return (
        f"{len(subject.dataset.frame_ids)} frames of {camera.width}×{camera.height} pixels, {truth}; voxels of "
        f"{millimetres(subject.voxel_size)}, truncated at {millimetres(base.truncation)}, and marching cubes, unless "
        f"said otherwise. Pictures are from frame {subject.view.frame}'s pose, unless said otherwise."
    )


def _facts(device: Device) -> list[tuple[str, str]]:
    """Return what the numbers were made with."""
    place = device.name if device.is_cuda else f"CPU, {psutil.cpu_count()} cores"
    return [("device", place), ("system", f"{platform.system()} {platform.machine()}"), *installed_versions().items()]
