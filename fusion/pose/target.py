"""What views are located in: a reconstruction on disk, or a CAD model; and the views of it that are compared first."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.interrupts import interrupts_held
from datagen.open_dataset import open_dataset
from datagen.rigid import Matrix, rigid
from fusion.devices import Device
from fusion.pose.cad_model import (
    MESH_SUFFIXES,
    VOXELS_ACROSS,
    CadModel,
    Renderer,
    check_size,
    views_around,
)
from fusion.pose.pose_model import PoseModel, prepare_model
from fusion.pose.reference_frame import ReferenceFrame
from fusion.pose.se3 import perturb
from fusion.pose.stages import StageName
from fusion.reconstruction_files import RECORD_FILE, VOLUME_FILE, ReconstructionRecord, read_record
from fusion.surface.marching_cubes import marching_cubes
from fusion.volume.volume_file import load_volume

REFERENCES = 3
"""How many of the nearest fused frames the epipolar stage looks for shared features in."""

_SIDES = np.radians([[0, 0, 0], [90, 0, 0], [-90, 0, 0], [0, 90, 0], [0, -90, 0], [180, 0, 0]])
"""From which a CAD model is rendered for features, besides the estimate: rotation vectors of the model."""

_LEAST_KEPT, _KEPT_WITHIN_SHARE = 0.85, 0.025
"""Of what is seen of a CAD model, by the volume that stands for it, to a share of its diameter."""

References = Callable[[Matrix, NDArray[np.int64]], list[ReferenceFrame]]
"""From an estimate, world_from_camera, and the indices of the nearest views, the frames to look for features in."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Target:
    """A model to locate views in.

    ``views`` are world_from_camera of what it is compared with first, ``numbers`` name them: fused frames, or rendered
    views in their order. The world's frame is the object's: the reconstruction's, or that of the CAD model's file.
    ``depth_max`` is the depth, metres, beyond which pixels are left out.
    """

    name: str
    model: PoseModel
    views: list[Matrix]
    numbers: list[int]
    references: References
    depth_max: float = float("inf")


def is_model_file(path: Path) -> bool:
    """Tell whether a path names a CAD model rather than the folder of a reconstruction."""
    return not path.is_dir() and (path.is_file() or path.suffix.lower() in MESH_SUFFIXES)


def open_reconstruction(folder: Path, *, device: Device, frames_for: Sequence[StageName]) -> Target:
    """Open a reconstruction, and its fused frames for the stages that ask for them.

    The epipolar stage cannot do without; the others take them where they still are. Raises InputError for files
    that cannot be used.
    """
    record = read_record(folder)
    views = [
        rigid(frame.world_from_camera, source=f"{folder / RECORD_FILE}: trajectory: frame {frame.frame}")
        for frame in record.trajectory
    ]
    there = (folder / record.dataset).is_dir()
    with_frames = "epipolar" in frames_for or (there and len(frames_for) > 1)
    volume = load_volume(folder / VOLUME_FILE, device=device)
    return Target(
        name=str(folder),
        model=prepare_model(volume, mesh=marching_cubes(volume, normals=True)),
        views=views,
        numbers=[frame.frame for frame in record.trajectory],
        references=_fused_frames(folder, record) if with_frames else lambda _estimate, _indices: [],
        depth_max=record.depth_max_m or float("inf"),
    )


def _fused_frames(folder: Path, record: ReconstructionRecord) -> References:
    fused = open_dataset(folder / record.dataset)
    farthest = record.depth_max_m or float("inf")

    def references(_estimate: Matrix, indices: NDArray[np.int64]) -> list[ReferenceFrame]:
        frames = [record.trajectory[int(i)].frame for i in indices[:REFERENCES]]
        return [
            ReferenceFrame(
                camera=fused.camera,
                color=fused.color(i),
                depth=np.where(fused.depth(i) <= farthest, fused.depth(i), np.float32(0)),
                world_from_camera=fused.world_from_camera(i),
            )
            for i in frames
        ]

    return references


def open_cad_model(
    path: Path,
    *,
    scale: float,
    camera: PinholeCamera,
    typical_depth: float | None,
    device: Device,
    frames_for: Sequence[StageName],
) -> Target:
    """Open a CAD model, ``scale`` metres a unit of its file, and choose views from all around for ``camera``.

    ``typical_depth`` is how far away the first query's object is, metres, None where that is not known. Of the stages
    ``frames_for`` the epipolar one alone is given views: the model is what it is, and depth has nothing to learn from
    them. Raises InputError for a file that cannot be used, and a size that cannot be meant.
    """
    with interrupts_held():  # which trimesh would swallow
        from fusion.pose.cad_model_file import read_cad_model  # noqa: PLC0415 - slow to import, and only this needs it

    cad = read_cad_model(path, scale=scale)
    check_size(cad, typical_depth)
    model = _of_cad(cad, device)
    views = views_around(model.centre_world, model.diameter, camera)
    return Target(
        name=str(path),
        model=model,
        views=views,
        numbers=list(range(len(views))),
        references=_rendered(cad, model, camera, device) if "epipolar" in frames_for else lambda _e, _i: [],
    )


def _of_cad(cad: CadModel, device: Device) -> PoseModel:
    """Return the model of a CAD model, of finer voxels where its walls are too thin for coarse ones.

    Raises InputError where the mesh encloses nothing, and where its walls are too thin for the finer ones, too.
    """
    for voxels in (VOXELS_ACROSS, 2 * VOXELS_ACROSS):
        try:
            model = prepare_model(cad.volume(device=device, voxels_across=voxels), outline=cad.mesh)
        except InputError as error:
            reason = f"{error}; is the mesh closed? Its inside has to be told from its outside"
            raise InputError(f"{cad.source}: {reason}") from None
        kept = cad.kept_by(model.mesh, within=_KEPT_WITHIN_SHARE * cad.diameter, device=device)
        if kept > _LEAST_KEPT:
            return model
    raise InputError(
        f"{cad.source}: only {kept:.0%} of its surface is left at voxels of {1000 * model.voxel_size:.2g} mm: its walls"
        " are thinner than that, or it is open; give a closed mesh, whose walls are a hundredth of its size"
    )


def _rendered(cad: CadModel, model: PoseModel, camera: PinholeCamera, device: Device) -> References:
    renderer = Renderer.of(cad, model.mesh, device=device)

    def references(estimate: Matrix, _indices: NDArray[np.int64]) -> list[ReferenceFrame]:
        if not cad.colored:
            return []
        # Shapes that look alike from several sides are told apart by their texture: all sides are asked.
        twists = np.hstack([np.zeros((len(_SIDES), 3)), _SIDES])
        frames = []
        for pose in perturb(twists, estimate, pivot_world=model.centre_world):
            color, depth = renderer.view(camera, pose)
            frames.append(ReferenceFrame(camera=camera, color=color, depth=depth, world_from_camera=pose))
        return frames

    return references
