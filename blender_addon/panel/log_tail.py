"""The end of a job's log, as lines that a panel has room for."""

from collections.abc import Iterable

EXPECTED = ("Warp CUDA warning: Could not find or load the NVIDIA CUDA driver",)
"""What is said on every machine without an NVIDIA card, where it is no news; the whole log has it."""


def worth_showing(lines: Iterable[str]) -> list[str]:
    """Return the lines of a log without those that are said however well all goes."""
    return [line for line in lines if not line.startswith(EXPECTED)]


def last_lines(wrapped: Iterable[list[str]], count: int) -> list[str]:
    """Return the last ``count`` of lines that were wrapped, with empty ones before where there are fewer.

    As many lines at all times: a panel that grows and shrinks moves what is below it away from the mouse.
    """
    lines = [line for part in wrapped for line in part][-count:]
    return [*([""] * (count - len(lines))), *lines]
