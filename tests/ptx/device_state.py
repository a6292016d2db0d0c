"""What all functions of the device share."""

import ctypes
from typing import Any

from ptx.memory import Memory
from ptx.streams import Streams

CONTEXT = 0xC0DA
CURRENT_STREAM = 2**64 - 1
"""Warp's way to say the current stream."""


def as_number(value: Any) -> int:
    """Return a handle or an address, however ctypes was handed it."""
    if value is None:
        return 0
    if hasattr(value, "contents"):
        return ctypes.addressof(value.contents)
    return int(value) if isinstance(value, int) else int(getattr(value, "value", None) or 0)


class DeviceState:
    """Memory, streams, and the handles that stand for events, graphs, modules and kernels."""

    core: Any
    memory: Memory
    streams: Streams
    _handles: dict[int, Any]
    _numbers: Any
    _contexts: list[int | None]
    _graphs_own: set[int]

    def _handle(self, what: Any) -> int:
        number = next(self._numbers)
        self._handles[number] = what
        return number

    def _stream(self, stream: Any) -> int:
        number = as_number(stream)
        return self.streams.current if number == CURRENT_STREAM else number
