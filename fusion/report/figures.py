"""The figures of a report: which reconstructions each one shows, and the numbers beneath its pictures."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.dataset import Dataset
from datagen.rigid import Matrix
from fusion.devices import Device
from fusion.frames.frame_source import FrameSource
from fusion.frames.survey import SceneSurvey, combine
from fusion.reconstruction_config import ReconstructionConfig, choose_lengths
from fusion.render import resized
from fusion.report.heat_map import heat
from fusion.report.mesh_picture import picture_of_mesh
from fusion.report.runs import Run, run
from fusion.surface.closest_points import closest_points
from fusion.surface.mesh import Mesh

FRAME_COUNTS = (10, 25, 50, 100, 200)
VOXEL_FACTORS = (8, 4, 2, 1)
TRUNCATION_VOXELS = (2, 4, 8, 16)
PICTURE_WIDTH = 480
WIDER = 0.85
"""The pictures' focal length to the frames': the object with some space around it."""


@dataclass(frozen=True, kw_only=True)
class Panel:
    """A picture (height, width, 3) RGB, its title, and what stands beneath it.

    ``name`` is its file's, unique in the dataset; ``heat_most_m`` are the metres at which a heat map ends, else None.
    """

    name: str
    title: str
    image: NDArray[np.uint8]
    numbers: tuple[tuple[str, str], ...] = ()
    heat_most_m: float | None = None


@dataclass(frozen=True, kw_only=True)
class Figure:
    """Pictures side by side, ``columns`` where there is room, under a heading, with a sentence on what to see."""

    heading: str
    text: str
    panels: tuple[Panel, ...]
    columns: int = 4


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A dataset as the report looks at it: reconstructions lie in ``folder``, pictures are from one view.

    ``base`` is the configuration that all figures vary, its lengths chosen.
    """

    name: str
    dataset: Dataset
    ground_truth: Mesh | None
    folder: Path
    base: ReconstructionConfig
    camera: PinholeCamera
    world_from_camera: Matrix
    view_frame: int
    device: Device
    advance: Callable[[], None] = lambda: None

    def config(self, **changes: object) -> ReconstructionConfig:
        """Return the configuration with some of it changed."""
        return replace(self.base, **changes)  # type: ignore[arg-type]

    def folder_of(self, config: ReconstructionConfig, kind: str = "") -> Path:
        """Return where the reconstruction with a configuration is kept."""
        digest = hashlib.sha256(json.dumps(asdict(config), sort_keys=True).encode()).hexdigest()
        return self.folder / f"{kind}{digest[:12]}"

    def reconstruct(self, *, keep_volume: bool = False, **changes: object) -> Run:
        """Reconstruct with some of the configuration changed; what two figures share is made once."""
        config = self.config(**changes)
        return run(self.dataset, self.folder_of(config), config, keep_volume=keep_volume)

    def picture(
        self,
        mesh: Mesh,
        colors: NDArray[np.floating] | None = None,
        *,
        shaded: bool = True,
        camera: PinholeCamera | None = None,
    ) -> NDArray[np.uint8]:
        """Return what the mesh looks like from the subject's view, or from there through another ``camera``."""
        return picture_of_mesh(
            mesh, camera or self.camera, self.world_from_camera, device=self.device, colors=colors, shaded=shaded
        )


def suitable_config(dataset: Dataset, config: ReconstructionConfig) -> ReconstructionConfig:
    """Return a configuration whose lengths are chosen from all of the dataset's frames, so that figures share them."""
    with FrameSource(dataset, dataset.frame_ids, depth_max=config.depth_max) as source:

        def survey() -> SceneSurvey:
            for _ in source.depth_batches():
                pass
            return combine(list(source.surveys.values()), dataset.camera)

        lengths = choose_lengths(config, survey)
    return replace(config, voxel_size=lengths.voxel_size, truncation=lengths.truncation)


def view_of(dataset: Dataset, frame_id: int) -> tuple[PinholeCamera, Matrix]:
    """Return a camera a bit wider than the frames', at a frame's pose, for pictures of the report's width."""
    camera = dataset.camera
    small = resized(camera, (PICTURE_WIDTH, round(PICTURE_WIDTH * camera.height / camera.width)))
    return replace(small, fx=small.fx * WIDER, fy=small.fy * WIDER), dataset.world_from_camera(frame_id)


def frame_counts(available: int) -> list[int]:
    """Return how many frames figure 7 takes, of so many."""
    counts = [count for count in FRAME_COUNTS if count < available]
    return counts if len(counts) == len(FRAME_COUNTS) else [*counts, available]


def growth(subject: Subject) -> Figure:
    """Figure 7: the mesh as frames come in."""
    panels = []
    for count in frame_counts(len(subject.dataset.frame_ids)):
        result = subject.reconstruct(frames=f"0:{count}")
        subject.advance()
        panels.append(mesh_panel(subject, result, f"frames-{count:03d}", f"{count} frames"))
    return Figure(
        heading="Fig. 7: the mesh as frames come in",
        columns=min(5, len(panels)),
        text="The first frames of the trajectory, fused. Error is measured where these frames saw the surface, so that "
        "it need not shrink; what grows is the surface.",
        panels=tuple(panels),
    )


def coloured(subject: Subject) -> Figure:
    """Figures 8 and 12: the coloured mesh beside what the camera saw."""
    result = subject.reconstruct()
    subject.advance()
    image = subject.dataset.color(subject.view_frame)
    panels = [
        Panel(name="photograph", title=f"frame {subject.view_frame} of the data", image=image),
        Panel(
            name="coloured",
            title="coloured mesh",
            image=subject.picture(result.mesh, _own_colors(result.mesh), shaded=False),
            numbers=sizes(result),
        ),
        mesh_panel(subject, result, "shape", "its shape"),
    ]
    error = error_panel(subject, result, "error", "error")
    return Figure(
        heading="Figs. 8 and 12: the coloured mesh",
        text="Each vertex has the mean of the colours that the frames saw there, weighted as distances are.",
        panels=tuple([*panels, error] if error is not None else panels),
    )


def voxel_sizes(subject: Subject) -> Figure:
    """Figure 9: coarse to fine."""
    assert subject.base.voxel_size is not None
    panels: list[Panel] = []
    for factor in VOXEL_FACTORS:
        size = subject.base.voxel_size * factor
        result = subject.reconstruct(voxel_size=size, truncation=4 * size)
        title = f"{1000 * size:.3g} mm voxels"
        subject.advance()
        panels.append(mesh_panel(subject, result, f"voxel-{factor}", title, extra=_cost(result)))
    return Figure(
        heading="Fig. 9: voxel sizes",
        text="Half the voxel, four times the triangles; the truncation is four voxels throughout.",
        panels=tuple(panels),
    )


def truncations(subject: Subject) -> Figure:
    """Figure 10: the truncation distance."""
    assert subject.base.voxel_size is not None
    panels: list[Panel] = []
    for voxels in TRUNCATION_VOXELS:
        distance = subject.base.voxel_size * voxels
        result = subject.reconstruct(truncation=distance)
        title = f"truncated at {1000 * distance:.3g} mm, {voxels} voxels"
        subject.advance()
        panels.append(mesh_panel(subject, result, f"truncation-{voxels}", title, extra=_cost(result)))
    return Figure(
        heading="Fig. 10: truncation distances",
        text="A small one keeps thin parts and their two sides apart, and needs depth without noise; a large one "
        "averages noise over more frames and lets one surface disturb the next.",
        panels=tuple(panels),
    )


def mesh_panel(subject: Subject, result: Run, name: str, title: str, extra: tuple[tuple[str, str], ...] = ()) -> Panel:
    """Return the mesh in clay, with its sizes and errors beneath and what is ``extra``."""
    return Panel(name=name, title=title, image=subject.picture(result.mesh), numbers=(*sizes(result), *extra))


def error_panel(subject: Subject, result: Run, name: str, title: str, *, most: float | None = None) -> Panel | None:
    """Return the mesh coloured by each vertex's distance to the truth, where there is one.

    Bright is ``most`` metres, half a voxel where that is None.
    """
    if subject.ground_truth is None:
        return None
    most = most or result.record.voxel_size_m / 2
    distances = closest_points(subject.ground_truth, result.mesh.vertices, device=subject.device).distances
    image = subject.picture(result.mesh, heat(distances, most=most))
    return Panel(name=name, title=title, image=image, heat_most_m=most)


def _own_colors(mesh: Mesh) -> NDArray[np.floating] | None:
    return None if mesh.colors is None else mesh.colors / 255


def sizes(result: Run) -> tuple[tuple[str, str], ...]:
    """Return what stands beneath each mesh."""
    record = result.record
    numbers = [("vertices", f"{record.vertices:,}"), ("triangles", f"{record.triangles:,}")]
    if record.metrics is not None:
        numbers.append(("chamfer", f"{1000 * record.metrics['chamfer_m']:.3g} mm"))
        numbers.append(("F at half a voxel", f"{100 * record.metrics['fscore']:.1f} %"))
    return tuple(numbers)


def _cost(result: Run) -> tuple[tuple[str, str], ...]:
    return (
        ("fusion", f"{result.record.frames_per_second:.0f} frames/s"),
        ("meshing", f"{1000 * result.record.seconds.mesh:.0f} ms"),
    )
