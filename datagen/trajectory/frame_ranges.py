"""Frames in words."""

from collections.abc import Sequence

MOST_RANGES = 10


def frame_ranges(frames: Sequence[int]) -> str:
    """Return increasing frame numbers as people say them: "frame 3", "frames 12–17 and 40"; of many the first."""
    ranges: list[list[int]] = []
    for frame in frames:
        if ranges and frame == ranges[-1][1] + 1:
            ranges[-1][1] = frame
        else:
            ranges.append([frame, frame])
    words = [f"{first}" if first == last else f"{first}–{last}" for first, last in ranges[:MOST_RANGES]]
    if len(ranges) > MOST_RANGES:
        words.append(f"{sum(last - first + 1 for first, last in ranges[MOST_RANGES:])} more")
    listed = words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
    return f"frame{'s' if len(frames) > 1 else ''} {listed}"
