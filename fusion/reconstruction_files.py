"""The reconstruction on disk: a folder of mesh.ply, volume.npz, reconstruction.json, and poses.json once located."""

import os
import platform
import sys
from collections.abc import Sequence
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
Answer = Literal["found", "doubtful", "not found"]


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
    """What a stage of refinement did (``fusion.pose.refinement.Refinement``); ``measurements`` are those it used."""

    stage: str
    converged: bool
    declined: bool
    reason: str
    residual: float | None
    unit: str
    measurements: int
    inlier_share: float
    overlap: float | None
    score: float | None


class PoseUncertainty(_Record):
    """How well depth or outline fixes a pose (``fusion.pose.uncertainty.Uncertainty``).

    ``deviations_mm`` ascending, of a point ``radius_m`` from ``pivot_world``, along the principal directions of motion;
    ``covariance`` (6, 6) of (v, ω), metres and radians, along the model's axes about the pivot; ``condition`` of the
    information. ``weak`` names the directions that are not fixed, in the model's frame.
    """

    deviations_mm: list[float]
    covariance: Rows
    pivot_world: list[float]
    radius_m: float
    condition: float
    weak: list[str]


class AlternativePose(_Record):
    """Another pose that explains the view as well: the model turned by ``turn_deg`` about ``axis``, its own frame.

    ``symmetric`` where the model looks the same from all sides after that, so that both poses mean the same.
    """

    turn_deg: float
    axis: list[float]
    symmetric: bool
    world_from_camera: Rows
    camera_from_object: Rows


class RefinedPose(_Record):
    """A located view's refined pose, whether it is to be believed, and what the stages did.

    The poses are absent where the verdict is "not found". ``evidence`` are the shares of
    ``fusion.pose.evidence.Evidence``, ``quality`` their product.
    """

    world_from_camera: Rows | None = None
    camera_from_object: Rows | None = None
    verdict: Answer
    reasons: list[str]
    quality: float | None = None
    evidence: dict[str, float]
    uncertainty: PoseUncertainty | None = None
    alternatives: list[AlternativePose]
    stages: list[StageResult]
    rotation_error_deg: float | None = None
    translation_error_m: float | None = None


class LocatedPose(_Record):
    """One entry of ``poses.json``.

    ``query`` is the frame's number, 0 for a single image. ``verdict`` is found, doubtful or not found, with
    ``reasons``; that of the refined pose where there is one. ``nearest`` is the number of a fused frame, or of a
    rendered view of a CAD model; ``score`` (m²) is the mean squared difference between the query's depth and that of
    the model seen from ``world_from_camera``, the pose of ``nearest`` (absent for a query without depth).
    ``nearest_frames`` are the nearest, best first; ``ambiguous`` where the view looks alike from another side.

    The world's frame is the object's: the reconstruction's, or that of the CAD model's file, in metres.
    ``camera_from_object`` is the inverse of ``world_from_camera``: the object's pose in the camera's frame, where it is
    the object that moves. Both are absent where the verdict is "not found". ``refined`` is there where stages of
    refinement were asked for. Errors are against the query's true pose.
    """

    query: int
    verdict: Answer
    reasons: list[str]
    nearest: int | None = None
    score: float | None = None
    world_from_camera: Rows | None = None
    camera_from_object: Rows | None = None
    nearest_frames: list[int] | None = None
    ambiguous: bool | None = None
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


def poses_as_json(poses: Sequence[LocatedPose]) -> list[dict[str, Any]]:
    """Return poses as they stand in ``poses.json``; what is not known is left out."""
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
