"""The report of some datasets: reconstructions, figures, table, page."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import warp as wp

from datagen.atomic_write import require_writable, write_bytes
from datagen.dataset import Dataset
from datagen.errors import InputError
from datagen.progress import ProgressReporter, silent
from fusion.devices import load_kernels, resolve_device
from fusion.reconstruction_config import ReconstructionConfig
from fusion.reconstruction_files import installed_versions
from fusion.report import figures, mesher_figure
from fusion.report.figures import Figure, Subject
from fusion.report.page import Section, Speed, encode_png, render_page
from fusion.surface.mesh_files import read_mesh

PAGE_FILE = "report.html"
IMAGES_FOLDER = "images"
RUNS_FOLDER = "runs"
KERNEL_MODULES = (
    "fusion.surface.closest_points",
    "fusion.surface.mesh_ray_casting",
    "fusion.evaluation.observed_surface",
)

PAPER = (("Stanford Bunny", 500, 296.67), ("Suzanne", 500, 530.74), ("Table with object", 500, 296.67))
"""Table I of the paper: frames and frames/s on its GPU; on its CPU all had 0.5."""


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
    ``view_frame`` is the frame from whose pose pictures are taken, the first where None. Raises InputError for datasets
    that share a name, and for everything that a reconstruction refuses.
    """
    require_writable(out)
    names = [_name(dataset) for dataset in datasets]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two datasets are called {name!r}; rename a folder")
    device = resolve_device(config.device)
    load_kernels(KERNEL_MODULES, device=device, progress=progress)
    sections, speeds = [], []
    for name, dataset in zip(names, datasets, strict=True):
        subject = _subject(name, dataset, out / RUNS_FOLDER / name, config, view_frame)
        made = _figures(subject, progress)
        _write_images(out / IMAGES_FOLDER / name, made)
        sections.append(Section(name=name, description=_description(subject), figures=made))
        speeds += _speeds(subject)
    speeds += [
        Speed(scene=scene, device="the paper's GPU", frames=frames, frames_per_second=rate, source="paper")
        for scene, frames, rate in PAPER
    ]
    speeds.append(Speed(scene="all three", device="the paper's CPU", frames=500, frames_per_second=0.5, source="paper"))
    page = render_page(sections, speeds, facts=list(installed_versions().items()))
    write_bytes(out / PAGE_FILE, page.encode())
    return out / PAGE_FILE


def _subject(
    name: str,
    dataset: Dataset,
    folder: Path,
    config: ReconstructionConfig,
    view_frame: int | None,
) -> Subject:
    frame = dataset.frame_ids[0] if view_frame is None else view_frame
    if frame not in dataset.frame_ids:
        raise InputError(f"--view-frame {frame}: {dataset.folder} has no such frame")
    device = resolve_device(config.device)
    camera, pose = figures.view_of(dataset, frame)
    return Subject(
        name=name,
        dataset=dataset,
        ground_truth=None if dataset.ground_truth_mesh is None else read_mesh(dataset.ground_truth_mesh),
        folder=folder,
        base=figures.suitable_config(dataset, replace(config, device=device.alias)),
        camera=camera,
        world_from_camera=pose,
        view_frame=frame,
        device=device,
    )


def _figures(subject: Subject, progress: ProgressReporter) -> tuple[Figure, ...]:
    """Make a dataset's figures: of a recording without a true mesh the coloured mesh alone, as in the paper."""
    if subject.ground_truth is None:
        subject = replace(subject, advance=progress(subject.name, 1))
        return (figures.coloured(subject),)
    steps = 1 + len(figures.frame_counts(len(subject.dataset.frame_ids))) + mesher_figure.RUNS
    steps += len(figures.VOXEL_FACTORS) + len(figures.TRUNCATION_VOXELS)
    subject = replace(subject, advance=progress(subject.name, steps))
    # First what needs the volumes, which are not kept.
    meshed = mesher_figure.meshers(subject)
    makers = (figures.coloured, figures.growth, figures.voxel_sizes, figures.truncations)
    return (*(maker(subject) for maker in makers), meshed)


def _speeds(subject: Subject) -> list[Speed]:
    """Fuse on every device there is: the table's row for each."""
    devices = ["cpu", *(device.alias for device in wp.get_cuda_devices()[:1])]
    records = [subject.reconstruct(device=device).record for device in devices]
    return [
        Speed(
            scene=subject.name,
            device=record.device,
            frames=record.frames,
            frames_per_second=record.frames_per_second,
            source="ours",
        )
        for record in records
    ]


def _write_images(folder: Path, made: Sequence[Figure]) -> None:
    for panel in (panel for figure in made for panel in figure.panels):
        write_bytes(folder / f"{panel.name}.png", encode_png(panel.image))


def _name(dataset: Dataset) -> str:
    return dataset.folder.resolve().name


def _description(subject: Subject) -> str:
    camera, base = subject.dataset.camera, subject.base
    assert base.voxel_size is not None
    assert base.truncation is not None
    truth = "with" if subject.ground_truth is not None else "without"
    return (
        f"{len(subject.dataset.frame_ids)} frames of {camera.width}×{camera.height} pixels, {truth} a true mesh; "
        f"voxels of {1000 * base.voxel_size:.3g} mm, truncation {1000 * base.truncation:.3g} mm unless said otherwise."
    )
