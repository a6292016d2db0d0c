"""Wall time by stage."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import warp as wp

from fusion.devices import Device


class Stopwatch:
    """Adds up wall time by stage, each until the device has done what it was given."""

    def __init__(self, device: Device) -> None:
        self.seconds: dict[str, float] = {}
        self._device = device

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Count the block's time to ``stage``."""
        start = time.perf_counter()
        yield
        wp.synchronize_device(self._device)
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start
