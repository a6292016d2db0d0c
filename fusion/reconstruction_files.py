"""The reconstruction on disk: a folder of mesh.ply, volume.npz, reconstruction.json, and poses.json once located."""

import os
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import psutil
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from datagen.atomic_write import write_json
from datagen.dataset_format import Intrinsics
from datagen.errors import InputError
from datagen.pydantic_errors import describe_validation_error

RECORD_FILE = "reconstruction.json"
MESH_FILE = "mesh.ply"
VOLUME_FILE = "volume.npz"
POSES_FILE = "poses.json"

Rows = list[list[float]]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Seconds(_Record):
    """Wall time by stage; the compiling of kernels is in none.

    ``waiting`` for frames that are still being decoded, ``allocate`` finding the blocks, ``integrate``, ``mesh``,
    ``evaluate`` the comparison with the truth, ``write`` the mesh and the volume. ``total`` has all of them, and not
    ``decode``: the processor time of the threads that decode while other stages run.
    """

    decode: float
    waiting: float
    allocate: float
    integrate: float
    mesh: float
    evaluate: float
    write: float
    total: float


class FusedFrame(_Record):
    """A frame that was fused, with its 4×4 pose as rows."""

    frame: int
    world_from_camera: Rows


class ReconstructionRecord(_Record):
    """The contents of ``reconstruction.json``.

    ``dataset`` is the dataset's folder relative to the reconstruction's. ``frames`` counts the fused frames, which
    ``trajectory`` lists; ``frames_per_second`` is that of finding blocks and integrating,
    ``frames_per_second_with_decoding`` has the time spent waiting for frames too. Of the volume's 512 voxels a block
    ``voxels_observed`` were seen by a frame; ``voxel_updates`` counts the voxels that integration went through, once a
    frame. ``depth_max_m`` is the depth beyond which pixels were left out, null for none. ``bounds_m`` are the corners
    of the union of the frusta cut at the observed depth, world frame. ``metrics`` compares the mesh with the ground
    truth, where there is one.
    """

    format: Literal["scanback-reconstruction"] = "scanback-reconstruction"
    version: Literal[1] = 1
    dataset: str
    frames: int = Field(ge=1)
    voxel_size_m: float = Field(gt=0)
    truncation_m: float = Field(gt=0)
    bounds_m: tuple[list[float], list[float]]
    blocks: int
    voxels_observed: int
    voxel_updates: int
    device: str
    seconds: Seconds
    frames_per_second: float
    frames_per_second_with_decoding: float
    vertices: int
    triangles: int
    peak_memory_mb: float
    metrics: dict[str, Any] | None
    camera: Intrinsics
    trajectory: list[FusedFrame] = Field(min_length=1)
    depth_max_m: float | None
    config: dict[str, Any]
    versions: dict[str, str]


class StageResult(_Record):
    """What a stage of refinement did (``fusion.pose.refinement.Refinement``)."""

    stage: str
    converged: bool
    declined: bool
    reason: str
    residual: float | None
    unit: str
    inlier_share: float
    overlap: float | None
    score: float | None


class RefinedPose(_Record):
    """A located frame's refined pose, whether it is to be believed, and what the stages did."""

    world_from_camera: Rows
    verdict: str
    reasons: list[str]
    stages: list[StageResult]
    rotation_error_deg: float | None = None
    translation_error_m: float | None = None


class LocatedPose(_Record):
    """One entry of ``poses.json``.

    ``query`` and ``nearest`` are frame numbers; ``score`` (m²) is the mean squared difference between the query's depth
    and that of the model seen from ``world_from_camera``, the pose of ``nearest``. ``nearest_frames`` are the nearest,
    best first; ``ambiguous`` where the view looks alike from another side. ``refined`` is there where stages of
    refinement were asked for. Errors are against the query's true pose.
    """

    query: int
    nearest: int
    score: float
    world_from_camera: Rows
    nearest_frames: list[int]
    ambiguous: bool
    refined: RefinedPose | None = None
    rotation_error_deg: float | None = None
    translation_error_m: float | None = None


def write_record(folder: Path, record: ReconstructionRecord) -> None:
    """Write ``reconstruction.json`` atomically."""
    write_json(folder / RECORD_FILE, record.model_dump(mode="json"))


def read_record(folder: Path) -> ReconstructionRecord:
    """Read ``reconstruction.json``; raises InputError naming the key at fault."""
    path = folder / RECORD_FILE
    try:
        return ReconstructionRecord.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); name a folder that fusion reconstruct wrote"
        ) from error
    except ValidationError as error:
        raise InputError(describe_validation_error(path, error, ReconstructionRecord)) from error


def poses_as_json(poses: list[LocatedPose]) -> list[dict[str, Any]]:
    """Return poses as they stand in ``poses.json``; errors are left out where the truth is not known."""
    return [pose.model_dump(mode="json", exclude_none=True) for pose in poses]


def relative_to(folder: Path, target: Path) -> str:
    """Return ``target`` relative to ``folder``, absolute where they are on different drives."""
    try:
        return os.path.relpath(target.resolve(), folder.resolve())
    except ValueError:
        return str(target.resolve())


def installed_versions() -> dict[str, str]:
    """Return the versions of what a reconstruction was made with."""
    found = {"python": platform.python_version()}
    for name in ("scanback", "numpy", "warp-lang", "opencv-python-headless", "trimesh"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def peak_memory_mb() -> float:
    """Return the most memory that this process has held, in MiB."""
    if sys.platform == "win32":
        return float(psutil.Process().memory_info().peak_wset) / 2**20
    import resource  # noqa: PLC0415 - not on Windows

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)
