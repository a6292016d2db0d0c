"""The dataset on disk: its file names and the contents of ``dataset.json``."""

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from datagen.atomic_write import write_json
from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.pydantic_errors import describe_validation_error
from datagen.scene_spec.sensor_settings import SensorSettings

METADATA_FILE = "dataset.json"
FRAMES_FOLDER = "frames"
GROUND_TRUTH_FILE = "ground_truth/mesh.ply"


def frame_file(folder: Path, frame_id: int, part: str) -> Path:
    """Return the path of one file of a frame; ``part`` is ``color.png``, ``depth.png`` or ``pose.txt``."""
    return folder / f"frame-{frame_id:06d}.{part}"


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Intrinsics(_Record):
    """The camera, as ``PinholeCamera`` has it: pixels, integer pixel centres."""

    width: int = Field(ge=1, le=65536)
    height: int = Field(ge=1, le=65536)
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def camera(self) -> PinholeCamera:
        """The same numbers as a camera that projects."""
        return PinholeCamera(**self.model_dump())


class Distortion(_Record):
    """The lens of the layers ``distorted_color`` and ``distorted_depth``: OpenCV's coefficients, in its rational model.

    ``intrinsics`` is the camera in whose pixels the distorted images are; ``shown`` is the share of these pixels that
    the rendered image reaches, the others being black and without depth.
    """

    k1: float
    k2: float
    p1: float
    p2: float
    k3: float
    k4: float
    k5: float
    k6: float
    intrinsics: Intrinsics
    shown: float = Field(ge=0, le=1)


class Conventions(_Record):
    """What the numbers of a dataset mean; written for readers who have only the files."""

    units: Literal["metres"] = "metres"
    depth: Literal["planar z, 0 = invalid"] = "planar z, 0 = invalid"
    pose: Literal["world_from_camera"] = "world_from_camera"
    camera_axes: Literal["x right, y down, z forward"] = "x right, y down, z forward"
    pixel_centre: Literal["integer"] = "integer"


class Metadata(_Record):
    """The contents of ``dataset.json``.

    ``depth_scale`` is metres per step of the 16-bit depth images; ``frames_per_second`` is the time base: frame i is
    at i / frames_per_second seconds. ``sensor`` is what the layer ``sensor_depth`` simulates, ``distortion`` the lens
    of the distorted layers. ``recipe`` holds all that decides what the frames show (scene, size, samples, seed) and
    ``provenance`` what was used to make them (versions, device).
    """

    format: Literal["scanback-dataset"] = "scanback-dataset"
    version: Literal[1] = 1
    frame_count: int = Field(ge=1, le=1_000_000)
    intrinsics: Intrinsics
    depth_scale: float = Field(gt=0, le=10)
    frames_per_second: float = Field(gt=0)
    conventions: Conventions = Conventions()
    layers: tuple[str, ...] = Field(default=(), strict=False)
    ground_truth_mesh: str | None = None
    sensor: SensorSettings | None = None
    distortion: Distortion | None = None
    recipe: dict[str, Any]
    provenance: dict[str, Any]


def read_metadata(folder: Path) -> Metadata:
    """Read ``dataset.json``; raises InputError naming the key at fault."""
    path = folder / METADATA_FILE
    try:
        return Metadata.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except ValidationError as error:
        raise InputError(describe_validation_error(path, error, Metadata)) from error


def write_metadata(folder: Path, metadata: Metadata) -> None:
    """Write ``dataset.json`` atomically."""
    write_json(folder / METADATA_FILE, metadata.model_dump(mode="json"))
