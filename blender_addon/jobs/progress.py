"""What a process says of itself: lines of JSON for its progress, all else for the log."""

import json
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

LOG_LINES = 200


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a stage is: ``done`` of ``total`` steps after ``seconds``."""

    stage: str
    done: int
    total: int
    seconds: float

    @property
    def fraction(self) -> float:
        """From 0 to 1."""
        return min(self.done / self.total, 1.0) if self.total > 0 else 0.0

    @property
    def seconds_left(self) -> float | None:
        """The time left if the rest goes as fast, None while nothing is done yet."""
        if self.done <= 0:
            return None
        return self.seconds * max(self.total - self.done, 0) / self.done

    def describe(self) -> str:
        """Return a line such as ``Rendering 12/60, 0:34 left``."""
        line = f"{self.stage.capitalize()} {self.done}/{self.total}"
        left = self.seconds_left
        return line if left is None or self.done >= self.total else f"{line}, {_clock(left)} left"


class ProcessLog:
    """The progress and the last lines of a process, from what it writes, however that is cut into pieces."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.lines: deque[str] = deque(maxlen=LOG_LINES)
        self.stage, self.done, self.total = "", 0, 0
        self._clock = clock
        self._stage_began = clock()
        self._rest = b""

    @property
    def progress(self) -> Progress | None:
        """How far the present stage is, None before the first one."""
        if not self.stage:
            return None
        return Progress(stage=self.stage, done=self.done, total=self.total, seconds=self._clock() - self._stage_began)

    def feed(self, data: bytes) -> None:
        """Take in what was written since the last call."""
        *whole, self._rest = (self._rest + data).split(b"\n")
        for line in whole:
            self._take(line.decode("utf-8", "replace").rstrip())

    def end(self) -> None:
        """Take in a last line that nothing ended."""
        self.feed(b"\n")

    def _take(self, line: str) -> None:
        if not line.startswith("{"):
            if line.strip():
                self.lines.append(line)
            return
        try:
            report = json.loads(line)
            stage, done, total = str(report["stage"]), int(report["done"]), int(report["total"])
        except (ValueError, KeyError, TypeError):
            self.lines.append(line)
            return
        if stage != self.stage or done < self.done:
            self._stage_began = self._clock()
        self.stage, self.done, self.total = stage, done, total


def _clock(seconds: float) -> str:
    whole = round(seconds)
    hours, minutes = whole // 3600, whole // 60 % 60
    return f"{hours}:{minutes:02d}:{whole % 60:02d}" if hours else f"{minutes}:{whole % 60:02d}"
