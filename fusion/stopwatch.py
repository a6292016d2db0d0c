"""Wall time by stage."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

import warp as wp

from fusion.devices import Device


class Stopwatch:
    """Adds up wall time by stage, each until the device has done what it was given; 0 for one that never ran."""

    def __init__(self, device: Device) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._device = device

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Count the block's time to ``stage``."""
        start = time.perf_counter()
        yield
        wp.synchronize_device(self._device)
        self.seconds[stage] += time.perf_counter() - start
