"""A reconstruction folder: ``mesh.ply``, ``reconstruction.json`` and, where frames were located, ``poses.json``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ReconstructionError
from .json_values import JsonValue, is_there, read_json
from .ply_mesh import ColoredMesh, read_colored_mesh

RECONSTRUCTION_FILE = "reconstruction.json"
MESH_FILE = "mesh.ply"
POSES_FILE = "poses.json"
FORMAT = "scanback-reconstruction"
VERSION = 1

Pose = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """A pinhole camera in pixels, integer pixel centres: u = fx·x/z + cx (OpenCV)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True, kw_only=True)
class FusedFrame:
    """A frame of the dataset that is part of the reconstruction, with its 4×4 pose in OpenCV camera axes."""

    frame: int
    world_from_camera: Pose


@dataclass(frozen=True, kw_only=True)
class LocatedFrame:
    """A frame that was located: ``nearest`` is the fused frame whose pose, ``world_from_camera``, explains it best.

    ``score`` is the error of that pose, None where it was found by an outline; the errors against the truth are None
    where it is not known.
    ``nearest_frames`` are the nearest, best first. ``refined`` is the frame's own pose where it was refined, with the
    ``verdict`` whether to believe it.
    """

    query: int
    nearest: int
    score: float | None
    world_from_camera: Pose
    rotation_error_deg: float | None
    translation_error_m: float | None
    nearest_frames: tuple[int, ...]
    refined: Pose | None
    verdict: str | None


@dataclass(frozen=True, kw_only=True)
class LostQuery:
    """A frame whose place was not found, and why."""

    query: int
    reasons: str


@dataclass(frozen=True, kw_only=True)
class Record:
    """What a reconstruction folder holds beside its mesh, as far as Blender shows it; world frame.

    The folder's lengths are metres; ``metres_per_unit`` is another unit where they were brought into a scene's
    (``results.scene_units``), but for what is named _m.
    """

    folder: Path
    dataset: Path
    intrinsics: Intrinsics
    voxel_size_m: float | None
    trajectory: tuple[FusedFrame, ...]
    located: tuple[LocatedFrame, ...]
    lost: tuple[LostQuery, ...] = ()
    metres_per_unit: float = 1.0

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.name


@dataclass(frozen=True, kw_only=True)
class Reconstruction(Record):
    """A whole reconstruction folder."""

    mesh: ColoredMesh

    def diagonal(self) -> float:
        """Return the diagonal of the box around mesh and camera path, the measure of all that is drawn."""
        positions = [frame.world_from_camera[:3, 3] for frame in self.trajectory]
        corners = [self.mesh.vertices_world.min(axis=0), self.mesh.vertices_world.max(axis=0), *positions]
        return float(np.linalg.norm(np.ptp(np.stack(corners), axis=0)))


def read_reconstruction(folder: Path) -> Reconstruction:
    """Read and check a reconstruction folder with its mesh; raises ReconstructionError as ``read_record`` does."""
    record = read_record(folder)
    return Reconstruction(**vars(record), mesh=read_colored_mesh(record.folder / MESH_FILE))


def read_record(folder: Path) -> Record:
    """Read and check a reconstruction folder but its mesh; frames are located where it holds ``poses.json``.

    Raises ReconstructionError naming the file, the value found there and the remedy.
    """
    folder = folder.resolve()
    if not is_there(folder):
        raise ReconstructionError(f"{folder}: no such folder; choose the one that 'fusion reconstruct' wrote")
    file = folder / RECONSTRUCTION_FILE
    if not is_there(file):
        raise ReconstructionError(
            f"{folder}: not a reconstruction: it holds no {RECONSTRUCTION_FILE}; "
            "choose the folder that 'fusion reconstruct' wrote"
        )
    record = read_json(file, remedy="write it again with 'fusion reconstruct'")
    _check_format(record)
    return Record(
        folder=folder,
        dataset=folder / record.member("dataset").text(),
        intrinsics=read_intrinsics(record.member("camera")),
        trajectory=tuple(_fused_frame(item) for item in record.member("trajectory").items()),
        **_read_located(folder / POSES_FILE),
        voxel_size_m=record.optional_number("voxel_size_m"),
    )


def _check_format(record: JsonValue) -> None:
    if record.member("format").value != FORMAT:
        record.member("format").refuse(f"{FORMAT!r}")
    version = record.member("version")
    if version.integer(at_least=1) != VERSION:
        raise ReconstructionError(
            f"{version.file}: version: found {version.value}, this extension reads {VERSION}; "
            "install the extension that came with the program that wrote it"
        )


def read_intrinsics(camera: JsonValue) -> Intrinsics:
    """Return the camera that a JSON object describes; raises ReconstructionError naming the key at fault."""
    return Intrinsics(
        width=camera.member("width").integer(at_least=1),
        height=camera.member("height").integer(at_least=1),
        fx=camera.member("fx").positive_number(),
        fy=camera.member("fy").positive_number(),
        cx=camera.member("cx").number(),
        cy=camera.member("cy").number(),
    )


def _fused_frame(item: JsonValue) -> FusedFrame:
    return FusedFrame(frame=item.member("frame").integer(), world_from_camera=item.member("world_from_camera").pose())


def _read_located(file: Path) -> dict[str, Any]:
    """Return the frames that were located, and those that were not: they have no pose."""
    if not is_there(file):
        return {"located": (), "lost": ()}
    poses = read_json(file, remedy="write it again with 'fusion locate', or delete it")
    located, lost = [], []
    for item in poses.items():
        verdict = item.optional_member("verdict")
        if verdict is not None and verdict.text() == "not found":
            reasons = "; ".join(reason.text() for reason in item.member("reasons").items())
            lost.append(LostQuery(query=item.member("query").integer(), reasons=reasons))
        else:
            located.append(_located_frame(item))
    return {"located": tuple(located), "lost": tuple(lost)}


def _located_frame(item: JsonValue) -> LocatedFrame:
    return LocatedFrame(
        query=item.member("query").integer(),
        nearest=item.member("nearest").integer(),
        score=item.optional_number("score"),
        world_from_camera=item.member("world_from_camera").pose(),
        rotation_error_deg=item.optional_number("rotation_error_deg"),
        translation_error_m=item.optional_number("translation_error_m"),
        nearest_frames=_nearest_frames(item),
        **_refined(item),
    )


def _nearest_frames(item: JsonValue) -> tuple[int, ...]:
    frames = item.optional_member("nearest_frames")
    if frames is None:
        return (item.member("nearest").integer(),)
    return tuple(frame.integer() for frame in frames.items())


def _refined(item: JsonValue) -> dict[str, Any]:
    refined = item.optional_member("refined")
    pose = None if refined is None else refined.optional_member("world_from_camera")
    if refined is None or pose is None:
        return {"refined": None, "verdict": None}
    return {"refined": pose.pose(), "verdict": refined.member("verdict").text()}
