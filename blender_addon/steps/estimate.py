"""How large a reconstruction will be, from what a command tells of a dataset once."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..jobs.command import Command
from ..jobs.job import Job, Work
from ..settings import note_devices

BLOCK_SIDE = 8
BYTES_PER_VOXEL = 8
MEAN_TAXICAB = 1.5
VOXELS_PER_TRUNCATION = 4


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """The surface's area times |nx| + |ny| + |nz| of its normal, m², and the voxel size that suits the data, metres.

    See ``fusion.estimate``, which has the formulas' reasons.
    """

    taxicab_area: float
    voxel_size: float

    def triangles(self, voxel_size: float) -> int:
        """Return about how many triangles there will be."""
        return round(2 * self.taxicab_area / voxel_size**2)

    def megabytes(self, voxel_size: float, truncation: float) -> float:
        """Return about how much memory the volume will take, MiB."""
        side = BLOCK_SIDE * voxel_size
        blocks = self.taxicab_area * (side + 2 * truncation / MEAN_TAXICAB) / side**3
        return blocks * BLOCK_SIDE**3 * BYTES_PER_VOXEL / 2**20


_known: dict[Path, Estimate] = {}


def known_estimate(dataset: Path) -> Estimate | None:
    """Return what was found out about a dataset, None before that."""
    return _known.get(dataset)


def note_estimate(dataset: Path, answer: Any) -> Estimate:
    """Keep what the command answered."""
    found = Estimate(taxicab_area=float(answer["taxicab_area"]), voxel_size=float(answer["voxel_size"]))
    _known[dataset] = found
    note_devices([str(name) for name in answer["devices"]])
    return found


def estimate_command(dataset: Path) -> Command:
    """Return the command that looks at a dataset."""
    return Command(
        program="fusion", arguments=("estimate", str(dataset), "--json"), failure="The size could not be estimated"
    )


def estimate_work(dataset: Path, *, in_words: Callable[[float], str]) -> Callable[[Job], Work[str]]:
    """Return the job that looks at a dataset; ``in_words`` says a length in metres."""

    def work(job: Job) -> Work[str]:
        found = note_estimate(dataset, (yield from job.run(estimate_command(dataset))))
        triangles = found.triangles(found.voxel_size)
        return f"Voxels of {in_words(found.voxel_size)} make about {triangles:,} triangles"

    return work
