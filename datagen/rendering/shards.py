"""A share of a dataset's frames, for one of several machines."""

import re
from dataclasses import dataclass

from datagen.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Shard:
    """Part ``number`` of ``count``, from 1: a run of frames, as long as that of any other part give or take one."""

    number: int = 1
    count: int = 1

    def __post_init__(self) -> None:
        """Refuse a part that there is not."""
        if not 1 <= self.number <= self.count:
            raise InputError(f"--shard {self}: expected I/N with I from 1 to N, for example 2/4")

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def frames(self, frame_count: int) -> range:
        """Return its frames of ``frame_count``; raises InputError where there are fewer frames than shards."""
        if self.count > frame_count:
            raise InputError(f"--shard {self}: there are only {frame_count} frames; use at most as many shards")
        return range((self.number - 1) * frame_count // self.count, self.number * frame_count // self.count)


def parse_shard(text: str) -> Shard:
    """Return the shard that ``I/N`` names. Raises InputError for anything else."""
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    if match is None:
        raise InputError(f"--shard {text}: expected I/N with I from 1 to N, for example 2/4")
    return Shard(number=int(match[1]), count=int(match[2]))
