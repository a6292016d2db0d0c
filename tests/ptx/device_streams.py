"""The device's functions for streams, events and graphs."""

from typing import Any

from ptx.device_state import DeviceState, as_number
from ptx.streams import Event, Graph


class StreamFunctions(DeviceState):
    """Named as Warp's native functions, with ``do_`` for ``wp_``."""

    def do_cuda_stream_create(self, _context: Any, _priority: int) -> int:
        number = next(self._numbers)
        self.streams.streams[number] = type(self.streams.streams[0])()
        return number

    def do_cuda_stream_destroy(self, _context: Any, stream: Any) -> None:
        gone = self.streams.streams[as_number(stream)]
        if gone.last is not None:
            self.streams.streams[0].waits.append(gone.last)
        del self.streams.streams[as_number(stream)]

    def do_cuda_stream_query(self, stream: Any) -> int:
        last = self.streams.streams[self._stream(stream)].last
        return 0 if last is None or last.done else 600

    def do_cuda_stream_synchronize(self, stream: Any) -> bool:
        self.streams.synchronize(self._stream(stream))
        return True

    def do_cuda_stream_is_capturing(self, stream: Any) -> int:
        return int(self.streams.streams[self._stream(stream)].capture is not None)

    def do_cuda_stream_get_capture_id(self, stream: Any) -> int:
        return self._stream(stream) + 1

    def do_cuda_stream_wait_event(self, stream: Any, event: Any, _external: Any) -> None:
        self.streams.wait(self._stream(stream), self._handles[as_number(event)])

    def do_cuda_stream_wait_stream(self, stream: Any, other: Any, event: Any, _external: Any) -> None:
        self.streams.record(self._handles[as_number(event)], self._stream(other))
        self.streams.wait(self._stream(stream), self._handles[as_number(event)])

    def do_cuda_event_create(self, _context: Any, _flags: int) -> int:
        return self._handle(Event())

    def do_cuda_event_destroy(self, event: Any) -> None:
        del self._handles[as_number(event)]

    def do_cuda_event_record(self, event: Any, stream: Any, _external: Any) -> None:
        self.streams.record(self._handles[as_number(event)], self._stream(stream))

    def do_cuda_event_query(self, event: Any) -> int:
        operation = self._handles[as_number(event)].operation
        return 0 if operation is None or operation.done else 600

    def do_cuda_event_synchronize(self, event: Any) -> bool:
        self.streams.refuse_in_capture("waiting for an event")
        self.streams.finish(self._handles[as_number(event)].operation)
        return True

    def do_cuda_graph_begin_capture(self, _context: Any, stream: Any, _external: int, _mode: int) -> bool:
        self.streams.begin_capture(self._stream(stream))
        return True

    def do_cuda_graph_end_capture(self, _context: Any, stream: Any, graph: Any) -> bool:
        graph._obj.value = self._handle(self.streams.end_capture(self._stream(stream)))
        return True

    def do_cuda_graph_create_exec(self, _context: Any, _stream: Any, graph: Any, executable: Any) -> bool:
        executable._obj.value = self._handle(self._handles[as_number(graph)])
        return True

    def do_cuda_graph_launch(self, executable: Any, stream: Any) -> bool:
        held = self._handles[as_number(executable)]
        assert isinstance(held, Graph), "a graph is launched"
        self.streams.launch(held, self._stream(stream))
        return True

    def do_cuda_graph_destroy(self, _context: Any, graph: Any) -> bool:
        del self._handles[as_number(graph)]
        return True

    def do_cuda_graph_exec_destroy(self, _context: Any, executable: Any) -> bool:
        del self._handles[as_number(executable)]
        return True
