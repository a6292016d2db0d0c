"""How long a tick keeps Blender's main thread, without what only a process that runs tests has in it."""

import gc
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

_Result = TypeVar("_Result")


class TickTime:
    """The longest tick so far, in seconds of this thread's processor time."""

    def __init__(self) -> None:
        self.longest = 0.0

    def of(self, tick: Callable[[], _Result]) -> _Result:
        """Call ``tick``, take its time, and return what it returns."""
        began = time.thread_time()
        result = tick()
        self.longest = max(self.longest, time.thread_time() - began)
        return result


@contextmanager
def timing_ticks() -> Iterator[TickTime]:
    """Time ticks while the block runs.

    The garbage collector leaves the objects alone that are there already. To look through those of the tests and their
    libraries, which no Blender has, takes it a tenth of a second, in a tick or wherever else it happens to begin.
    """
    gc.freeze()
    try:
        yield TickTime()
    finally:
        gc.unfreeze()
