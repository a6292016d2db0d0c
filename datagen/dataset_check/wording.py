"""Numbers of things, and lists of frames, in words."""

from collections.abc import Sequence

MOST_LISTED = 8


def counted(count: int, noun: str) -> str:
    """Return ``1 frame``, ``2 frames``."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def listed(frames: Sequence[int]) -> str:
    """Return frame numbers, the first few of many."""
    shown = ", ".join(str(frame) for frame in frames[:MOST_LISTED])
    return shown if len(frames) <= MOST_LISTED else f"{shown} and {len(frames) - MOST_LISTED} more"


def length(metres: float) -> str:
    """Return a length with a unit that suits it, three digits."""
    size = abs(metres)
    if size < 1e-3:
        return f"{metres * 1e6:.3g} µm"
    return f"{metres * 1e3:.3g} mm" if size < 1 else f"{metres:.3g} m"
