"""The options of a reconstruction, and what the data suggest where an option is left open."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import get_args

from datagen.errors import InputError
from fusion.frames.survey import SceneSurvey
from fusion.integration.options import Integration
from fusion.surface.meshers import Mesher, OracleName
from fusion.volume.voxels import BYTES_PER_VOXEL, Storage

EXACT = Integration(depth_sampling="bilinear", drop_off=True)
"""What leads closest to the surface: outlines do not fray, and the two sides of thin parts disturb each other less."""

VOXELS_PER_TRUNCATION = 4
MOST_VOXELS_PER_TRUNCATION = 64
FOOTPRINTS_PER_VOXEL = 2
VOXELS_PER_EXTENT = 512
SMALLEST_LENGTH, LARGEST_LENGTH = 1e-6, 1e4
MOST_FLATNESS = 1.0
"""Voxels."""


@dataclass(frozen=True, kw_only=True)
class ReconstructionConfig:
    """What ``fusion reconstruct`` was asked for; None leaves a length to the data.

    ``voxel_size``, ``truncation`` and ``depth_max`` are metres; ``frames`` is START:STOP:STEP; ``device`` auto, cpu or
    cuda[:N]; ``storage`` the form of the volume (``fusion.volume.voxels``); ``integration`` how frames are sampled and
    weighed; only voxels with more than ``min_weight`` are meshed, by ``mesher``; ``oracle`` is what dual contouring
    asks, and ``flatness`` how many voxels the mesh may be off where it merges cells, 0 for none; both are nothing to
    marching cubes (``fusion.surface.meshers``); ``depth_layer`` is a layer of the dataset to fuse in the place of its
    depth (``Dataset.with_depth_layer``). Raises InputError for a length that is not from a
    micrometre to ten kilometres, and for options that there are not.
    """

    voxel_size: float | None = None
    truncation: float | None = None
    depth_max: float | None = None
    frames: str | None = None
    device: str = "auto"
    storage: Storage = "packed"
    min_weight: float = 0.0
    integration: Integration = EXACT
    mesher: Mesher = "marching-cubes"
    oracle: OracleName = "depth"
    flatness: float = 0.0
    depth_layer: str | None = None

    def __post_init__(self) -> None:
        """Refuse lengths that make no volume."""
        if not 0 <= self.min_weight < float("inf"):
            raise InputError(f"--min-weight {self.min_weight:g}: expected 0 or more, the weight of so many frames")
        if not 0 <= self.flatness <= MOST_FLATNESS:
            raise InputError(f"--flatness {self.flatness:g}: expected 0 (off) to {MOST_FLATNESS:g} voxels")
        if self.storage not in BYTES_PER_VOXEL:
            raise InputError(f"--storage {self.storage}: expected one of {', '.join(BYTES_PER_VOXEL)}")
        for option, value, known in (
            ("--mesher", self.mesher, get_args(Mesher)),
            ("--oracle", self.oracle, get_args(OracleName)),
        ):
            if value not in known:
                raise InputError(f"{option} {value}: expected one of {', '.join(known)}")
        for name in ("voxel_size", "truncation", "depth_max"):
            value = getattr(self, name)
            if value is not None:
                check_length(f"--{name.replace('_', '-')}", value)


@dataclass(frozen=True, kw_only=True)
class Lengths:
    """The volume's lengths as used, metres; ``truncation_is_given`` tells one that was asked for from a default."""

    voxel_size: float
    truncation: float
    truncation_is_given: bool

    def with_voxel_size(self, voxel_size: float) -> "Lengths":
        """Return what another voxel size would lead to: a truncation that was asked for stays."""
        truncation = self.truncation if self.truncation_is_given else VOXELS_PER_TRUNCATION * voxel_size
        return Lengths(voxel_size=voxel_size, truncation=truncation, truncation_is_given=self.truncation_is_given)


def check_length(option: str, value: float) -> None:
    """Raise InputError, naming ``option``, unless ``value`` is a length in metres that makes sense."""
    if not SMALLEST_LENGTH <= value <= LARGEST_LENGTH:
        raise InputError(
            f"{option} {value:g}: expected a positive number of metres, from {SMALLEST_LENGTH:g} to {LARGEST_LENGTH:g}"
        )


def check_meshing(mesher: Mesher, *, oracle: OracleName | None, flatness: float | None) -> None:
    """Raise InputError where an option of dual contouring was given, not None, that ``mesher`` takes no notice of."""
    if mesher == "marching-cubes" and oracle is not None:
        raise InputError(f"--oracle {oracle}: marching cubes asks no oracle; add --mesher dual-contouring")
    if mesher == "marching-cubes" and flatness:
        raise InputError(f"--flatness {flatness:g}: marching cubes merges no cells; add --mesher dual-contouring")


def choose_lengths(config: ReconstructionConfig, survey_scene: Callable[[], SceneSurvey]) -> Lengths:
    """Return the lengths that were asked for, and for those left open what suits the data, which are surveyed then.

    The voxel is twice a pixel's footprint wide, below which it sees noise of single pixels, but no less than a 512th of
    the extent, so that a large scene stays affordable; two digits. The truncation is four voxels. Raises InputError for
    a truncation that is less than a voxel, or so many voxels that it would fill the space between surfaces.
    """
    voxel_size = config.voxel_size or _suitable_voxel_size(survey_scene())
    truncation = config.truncation or VOXELS_PER_TRUNCATION * voxel_size
    if not voxel_size <= truncation <= MOST_VOXELS_PER_TRUNCATION * voxel_size:
        origin = "" if config.voxel_size else ", which the data suggest,"
        raise InputError(
            f"--truncation {truncation:g}: expected 1 to {MOST_VOXELS_PER_TRUNCATION} voxels of {voxel_size:g} m"
            f"{origin} for example {VOXELS_PER_TRUNCATION * voxel_size:g}"
        )
    return Lengths(voxel_size=voxel_size, truncation=truncation, truncation_is_given=config.truncation is not None)


def _suitable_voxel_size(survey: SceneSurvey) -> float:
    size = max(FOOTPRINTS_PER_VOXEL * survey.pixel_footprint, survey.typical_extent / VOXELS_PER_EXTENT)
    return float(f"{size:.2g}")
