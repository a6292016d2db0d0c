"""A dataset as a report looks at it: what is fused from it, the truth it is held against, the views of its pictures."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.dataset import Dataset
from datagen.rigid import Matrix
from fusion.devices import Device
from fusion.evaluation.evaluate import Observers, SurfaceSamples, evaluate, seen_truth
from fusion.frames.frame_source import FrameSource
from fusion.frames.survey import SceneSurvey, combine
from fusion.reconstruction_config import ReconstructionConfig, choose_lengths
from fusion.render import resized
from fusion.report.mesh_picture import picture_of_mesh
from fusion.report.runs import Run, run
from fusion.surface.mesh import Mesh

PICTURE_WIDTH = 480
MARGIN = 0.06
"""Of an object's size, left free around it in pictures."""


@dataclass(frozen=True, kw_only=True)
class Truth:
    """The true mesh, and points of it that the dataset's frames saw."""

    mesh: Mesh
    seen: SurfaceSamples


@dataclass(frozen=True, kw_only=True)
class View:
    """From where pictures are taken: a camera of the report's width at the pose of a frame."""

    frame: int
    camera: PinholeCamera
    world_from_camera: Matrix


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A dataset as the report looks at it: reconstructions lie in ``folder``, pictures are from one view.

    ``base`` is the configuration that all figures vary, its lengths chosen. ``advance`` is called after each of the
    reconstructions and meshes that figures ask for.
    """

    name: str
    dataset: Dataset
    truth: Truth | None
    folder: Path
    base: ReconstructionConfig
    view: View
    device: Device
    advance: Callable[[], None] = lambda: None

    @property
    def voxel_size(self) -> float:
        """The voxel size that figures vary, metres."""
        assert self.base.voxel_size is not None
        return self.base.voxel_size

    @property
    def observers(self) -> Observers:
        """All of the dataset's frames."""
        return Observers(dataset=self.dataset, frame_ids=self.dataset.frame_ids, depth_max=self.base.depth_max)

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

    def seen_from(self, frame: int) -> "Subject":
        """Return the subject with its pictures taken from another frame."""
        return replace(self, view=view_of(self.dataset, frame))

    def picture(
        self,
        mesh: Mesh,
        colors: NDArray[np.floating] | None = None,
        *,
        shaded: bool = True,
        wires: bool = False,
        camera: PinholeCamera | None = None,
    ) -> NDArray[np.uint8]:
        """Return what the mesh looks like from the subject's view, or from there through another ``camera``."""
        return picture_of_mesh(
            mesh,
            camera or self.view.camera,
            self.view.world_from_camera,
            device=self.device,
            colors=colors,
            shaded=shaded,
            wires=wires,
        )

    def judge(self, mesh: Mesh) -> dict[str, Any] | None:
        """Hold a mesh against what all frames saw of the truth, by one measure whatever its voxels; None without it."""
        if self.truth is None:
            return None
        thresholds = (self.voxel_size / 2, self.voxel_size)
        return evaluate(mesh, self.truth.mesh, thresholds=thresholds, device=self.device, seen=self.truth.seen)


def truth_of(dataset: Dataset, mesh: Mesh | None, *, depth_max: float | None, device: Device) -> Truth | None:
    """Return a dataset's true ``mesh`` with what its frames saw of it; None for None."""
    if mesh is None:
        return None
    observers = Observers(dataset=dataset, frame_ids=dataset.frame_ids, depth_max=depth_max)
    return Truth(mesh=mesh, seen=seen_truth(mesh, observers, device=device))


def suitable_config(dataset: Dataset, config: ReconstructionConfig) -> ReconstructionConfig:
    """Return a configuration whose lengths are chosen from all of the dataset's frames, so that figures share them."""
    with FrameSource(dataset, dataset.frame_ids, depth_max=config.depth_max) as source:

        def survey() -> SceneSurvey:
            for _ in source.depth_batches():
                pass
            return combine(list(source.surveys.values()), dataset.camera)

        lengths = choose_lengths(config, survey)
    return replace(config, voxel_size=lengths.voxel_size, truncation=lengths.truncation)


def view_of(dataset: Dataset, frame: int) -> View:
    """Return a view from a frame's pose onto what has depth in that frame: an object fills the picture, a room too."""
    camera = dataset.camera
    v, u = np.nonzero(dataset.depth(frame) > 0)
    low, high = (np.array([u.min(), v.min()]), np.array([u.max(), v.max()])) if len(u) else (np.zeros(2), np.zeros(2))
    size = np.array([camera.width, camera.height])
    share = float(((high - low + 1) * (1 + 2 * MARGIN) / size).max()) if len(u) else 1.0
    share = min(share, 1.0)
    # The part of the frame that is shown, in its pixels: never beyond its edges.
    corner = np.clip((low + high + 1) / 2 - share * size / 2, 0, (1 - share) * size)
    part = replace(
        camera,
        fx=camera.fx / share,
        fy=camera.fy / share,
        cx=(camera.cx + 0.5 - corner[0]) / share - 0.5,
        cy=(camera.cy + 0.5 - corner[1]) / share - 0.5,
    )
    small = resized(part, (PICTURE_WIDTH, round(PICTURE_WIDTH * camera.height / camera.width)))
    return View(frame=frame, camera=small, world_from_camera=dataset.world_from_camera(frame))
