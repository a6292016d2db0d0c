"""A subject from a dataset: some frames fused, the others held out to be located."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from datagen.dataset import Dataset
from datagen.errors import InputError
from datagen.frame_selection import select_frames
from datagen.progress import ProgressReporter, silent
from datagen.rigid import Matrix, rigid
from fusion.devices import Device
from fusion.evaluation.pose_errors import ModelPoints
from fusion.evaluation.symmetries import symmetry_transforms
from fusion.frames.survey import combine, load, survey_frame
from fusion.pose.pose_model import PoseModel, prepare_model
from fusion.pose.reference_frame import ReferenceFrame
from fusion.pose.view_index import index_views
from fusion.pose_benchmark.object_box import ObjectBox
from fusion.pose_benchmark.subjects import Fused, Kind, Subject
from fusion.pose_benchmark.views import View
from fusion.reconstruct import reconstruct
from fusion.reconstruction_config import FOOTPRINTS_PER_VOXEL, ReconstructionConfig
from fusion.reconstruction_files import (
    MESH_FILE,
    RECORD_FILE,
    VOLUME_FILE,
    ReconstructionRecord,
    installed_versions,
    read_record,
    relative_to,
)
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_files import read_mesh
from fusion.volume.volume_file import load_volume
from fusion.volume.volume_operations import crop

VOXELS_PER_EXTENT = 1024
"""Twice as many as a reconstruction has for show: what views are located in is neither looked at nor sent to anybody,
and a surface's voxels, in a band about it, grow with the square of this alone."""
_SURVEYED = 32
"""Frames that tell the lengths, evenly chosen."""
OBJECT_HOLDS_OUT = "2::5"
ROOM_FUSES = "::10"
MODEL_POINTS = 5000
"""Of the true surface, equally many for equal area."""
_POINTS_TO_CHOOSE_FROM = 20 * MODEL_POINTS
BOX_SUFFIX = "-in-box"
_LOOKED_AT, _LEAST_BESIDE = 5, 0.01
"""Frames, and the share of an image that is not of the model."""


def scanned_subject(
    dataset: Dataset,
    folder: Path,
    *,
    kind: Kind,
    fuse: str | None,
    voxel_size: float | None,
    box: ObjectBox | None = None,
    device: Device,
    progress: ProgressReporter = silent,
) -> Subject:
    """Fuse some of a dataset's frames into ``folder``, or read what lies there of them, and hold out the others.

    ``fuse`` is START:STOP:STEP; without it all frames but every fifth of an object, every tenth of a room. Without a
    ``voxel_size`` it is that of ``locating_voxel_size``; of a room, whose recorded poses do not agree as exactly as its
    pixels are fine, that of any reconstruction. What lies in a ``box`` is the object: the model is cropped to it, and a
    view's mask is what its true pose and depth show of it. Raises InputError where no frame is left to locate, and for
    everything that a reconstruction refuses.
    """
    fused_frames = _fused_frames(dataset, kind, fuse)
    held_out = tuple(i for i in dataset.frame_ids if i not in set(fused_frames))
    if not held_out:
        raise InputError(f"{dataset.folder}: all of its frames are fused, none is left to locate; fuse fewer")
    dataset.require(dataset.frame_ids)
    if voxel_size is None and kind == "object":
        voxel_size = locating_voxel_size(dataset, fused_frames)
    record = _reconstruction(dataset, folder, fused_frames, voxel_size, device, progress)
    volume = load_volume(folder / VOLUME_FILE, device=device)
    model = prepare_model(volume if box is None else crop(volume, box.low, box.high))
    views = _Views(dataset=dataset, box=box)
    return Subject(
        name=dataset.folder.resolve().name + ("" if box is None else BOX_SUFFIX),
        kind=kind,
        model=model,
        points=ModelPoints(points=_true_points(dataset, model, box), symmetries=symmetry_transforms()),
        queries=held_out,
        view=views.view,
        fused=_fused(views, record, model, device),
        identity=_identity(record, box),
        has_outline=views.show_an_outline(held_out),
    )


def locating_voxel_size(dataset: Dataset, frames: Sequence[int]) -> float:
    """Return the voxels, metres, with which frames are fused so that others can be located as exactly as these tell.

    They are two of a pixel's footprints wide, as where a reconstruction's are left to the data: a coarser model knows
    less than its frames do. But no less than a 1024th of the extent, where a reconstruction stops at a 512th; two
    digits. Raises InputError where no frame has a valid depth.
    """
    load()
    some = {frames[i] for i in np.linspace(0, len(frames) - 1, _SURVEYED).round().astype(int)}
    scene = combine(
        [
            survey_frame(
                dataset.camera,
                dataset.depth_steps(i),
                dataset.world_from_camera(i),
                depth_scale=dataset.depth_scale,
            )
            for i in sorted(some)
        ],
        dataset.camera,
    )
    size = max(FOOTPRINTS_PER_VOXEL * scene.pixel_footprint, scene.typical_extent / VOXELS_PER_EXTENT)
    return float(f"{size:.2g}")


def _fused_frames(dataset: Dataset, kind: Kind, fuse: str | None) -> tuple[int, ...]:
    if fuse is not None or kind == "room":
        return select_frames(dataset.frame_ids, fuse or ROOM_FUSES)
    held_out = set(select_frames(dataset.frame_ids, OBJECT_HOLDS_OUT))
    return tuple(i for i in dataset.frame_ids if i not in held_out)


def _reconstruction(
    dataset: Dataset,
    folder: Path,
    frames: tuple[int, ...],
    voxel_size: float | None,
    device: Device,
    progress: ProgressReporter,
) -> ReconstructionRecord:
    """Fuse ``frames`` alone; the dataset that is handed on does not even know the others."""
    config = ReconstructionConfig(voxel_size=voxel_size, device=device.alias)
    record = _kept(dataset, folder, frames, config)
    if record is not None:
        return record
    some = replace(dataset, frames={i: dataset.frames[i] for i in frames}, ground_truth_mesh=None)
    return reconstruct(some, folder, config, progress=progress).record


def _kept(
    dataset: Dataset, folder: Path, frames: tuple[int, ...], config: ReconstructionConfig
) -> ReconstructionRecord | None:
    """Return the record of a reconstruction that was made of the same by the same, None where there is none."""
    if not all((folder / name).is_file() for name in (RECORD_FILE, VOLUME_FILE, MESH_FILE)):
        return None
    try:
        record = read_record(folder)
    except InputError:  # of an older version, or damaged: it is made anew
        return None
    same = (
        record.dataset == relative_to(folder, dataset.folder)
        and tuple(frame.frame for frame in record.trajectory) == frames
        and record.config == asdict(config)
        and record.versions == installed_versions()
    )
    return record if same else None


def _identity(record: ReconstructionRecord, box: ObjectBox | None) -> str:
    """Return a digest of what the model was made of; its times are not part of it."""
    told = record.model_dump(mode="json", include={"trajectory", "voxel_size_m", "truncation_m", "config", "versions"})
    if box is not None:
        told["box"] = asdict(box)
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Views:
    """A dataset's frames, with masks of what lies in the box if there is one."""

    dataset: Dataset
    box: ObjectBox | None

    def mask(self, frame: int, world_from_camera: Matrix) -> NDArray[np.bool_] | None:
        if self.box is None:
            return None
        return self.box.mask(self.dataset.depth(frame), self.dataset.camera, world_from_camera)

    def view(self, frame: int) -> View:
        pose = self.dataset.world_from_camera(frame)
        return View(
            camera=self.dataset.camera,
            color=self.dataset.color(frame),
            depth=self.dataset.depth(frame),
            mask=self.mask(frame, pose),
            world_from_camera=pose,
        )

    def reference(self, frame: int, world_from_camera: Matrix) -> ReferenceFrame:
        depth, mask = self.dataset.depth(frame), self.mask(frame, world_from_camera)
        return ReferenceFrame(
            camera=self.dataset.camera,
            color=self.dataset.color(frame),
            depth=depth if mask is None else np.where(mask, depth, np.float32(0)),
            world_from_camera=world_from_camera,
        )

    def show_an_outline(self, frames: Sequence[int]) -> bool:
        """Tell whether any of some frames has pixels that are not of the model: else there is no outline to see."""
        some = frames[:: max(len(frames) // _LOOKED_AT, 1)]
        return any((~self.view(frame).seen).mean() > _LEAST_BESIDE for frame in some)


def _fused(views: _Views, record: ReconstructionRecord, model: PoseModel, device: Device) -> Fused:
    poses = {
        frame.frame: rigid(frame.world_from_camera, source=f"{RECORD_FILE}: frame {frame.frame}")
        for frame in record.trajectory
    }
    index = index_views(model.mesh, list(poses.values()), views.dataset.camera, device=device)
    return Fused(poses=poses, index=index, reference=lambda frame: views.reference(frame, poses[frame]))


def _true_points(dataset: Dataset, model: PoseModel, box: ObjectBox | None) -> NDArray[np.float64]:
    """Return points of the true surface, of the fused one where the truth is not known."""
    if dataset.ground_truth_mesh is None:
        return surface_sample(model.mesh, MODEL_POINTS)
    truth = read_mesh(dataset.ground_truth_mesh)
    if box is None:
        return surface_sample(truth, MODEL_POINTS)
    points = surface_sample(truth, _POINTS_TO_CHOOSE_FROM)
    return points[box.holds(points)][:MODEL_POINTS]


def surface_sample(mesh: Mesh, count: int) -> NDArray[np.float64]:
    """Return ``count`` points (count, 3) of a mesh, equally many for equal area, always the same."""
    shape = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    points, _triangles = trimesh.sample.sample_surface(shape, count, seed=0)
    return np.asarray(points, dtype=np.float64)
