"""Ctrl-C where it has to wait: some packages swallow it while they are imported, and Blender does while it renders."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Hold Ctrl-C back while the block runs; it raises KeyboardInterrupt as soon as the block is left.

    Where Ctrl-C does something else, or nothing, and outside the main thread, that stays as it is.
    """
    is_usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not is_usual or threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    signal.signal(signal.SIGINT, lambda number, frame: came.append(number))  # noqa: ARG005 - as signals call it
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if came:
        raise KeyboardInterrupt
