"""What became of one query in one trial, in a file of its own: a run that was interrupted goes on where it stopped."""

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from datagen.atomic_write import write_bytes
from fusion.reconstruction_files import Rows


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class PoseErrors(_Record):
    """Errors of a pose (``fusion.evaluation.pose_errors``); of the camera alone in a room, the others null there.

    ``fixed_rotation_deg`` is the rotation error as far as the shape fixes it: of a body of revolution, the tilt of its
    axis. ``translation_m`` is how far the object's middle is off in the camera's frame, in a room how far the camera
    is. An error in the image is null where a point comes to lie behind the camera; of a scene around the camera, errors
    are of the points in the image. ``vsd`` is there where it was asked for.
    """

    rotation_deg: float
    translation_m: float
    fixed_rotation_deg: float | None = None
    add_m: float | None = None
    add_s_m: float | None = None
    projection_px: float | None = None
    mssd_m: float | None = None
    mspd_px: float | None = None
    vsd: tuple[float, ...] | None = None


class Cost(_Record):
    """Seconds of processor time, of all threads together, and by the clock."""

    processor_s: float
    wall_s: float

    @property
    def quiet_s(self) -> float:
        """What a quiet machine needs at most: the clock also counts others' work, the processor that of all cores."""
        return min(self.processor_s, self.wall_s)


class NearestFound(_Record):
    """Which fused frame was taken for the nearest, how far it is from the query, and how far the nearest one is.

    Distances are radians: √(θ² + (‖t‖/z)²) with z the median depth of what is seen of the model.
    """

    frame: int
    distance: float
    least_distance: float
    ambiguous: bool
    cost: Cost


class CaseResult(_Record):
    """One query of one trial.

    ``identity`` is a digest of everything that leads to the result, but for the program. Poses are world_from_camera.
    Where nothing was found, ``failure`` says why and ``estimate`` and ``errors`` are null.
    """

    subject: str
    trial: str
    frame: int
    repeat: int
    identity: str
    diameter_m: float
    truth: Rows
    start: Rows | None = None
    start_errors: PoseErrors | None = None
    estimate: Rows | None = None
    errors: PoseErrors | None = None
    nearest: NearestFound | None = None
    verdict: str | None = None
    reasons: tuple[str, ...] = ()
    failure: str | None = None
    cost: Cost | None = None

    @property
    def title(self) -> str:
        """Name the case for people."""
        return f"{self.subject}, frame {self.frame}" + (f", start {self.repeat}" if self.repeat else "")


def case_file(folder: Path, subject: str, trial: str, frame: int, repeat: int) -> Path:
    """Return where a case's result lies."""
    return folder / subject / trial / f"frame-{frame:06d}-{repeat}.json"


def read_case(path: Path, *, identity: str) -> CaseResult | None:
    """Return a result that is there already and of the same case, None where it has to be made, or made again."""
    try:
        result = CaseResult.model_validate_json(path.read_bytes())
    except (OSError, ValidationError):
        return None
    return result if result.identity == identity else None


def write_case(path: Path, result: CaseResult) -> None:
    """Write a result atomically."""
    write_bytes(path, (result.model_dump_json(indent=1) + "\n").encode())


def errors_as_json(results: list[CaseResult]) -> list[dict[str, Any]]:
    """Return results as they stand in their files, without poses."""
    return [result.model_dump(mode="json", exclude={"truth", "start", "estimate", "identity"}) for result in results]
