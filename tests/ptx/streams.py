"""Streams, events and graphs, without a device: what was issued runs at once, or only when somebody waits for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

Work = Callable[[], None]


@dataclass(eq=False)
class Operation:
    """Something issued to a stream, and what it comes after."""

    work: Work
    after: list[Operation]
    done: bool = False


@dataclass(eq=False)
class Graph:
    """What a capture recorded, in the order in which it was issued."""

    works: list[Work] = field(default_factory=list)


@dataclass(eq=False)
class Stream:
    """Operations one after the other; those of ``waits`` come before the next."""

    last: Operation | None = None
    waits: list[Operation] = field(default_factory=list)
    capture: Graph | None = None


@dataclass(eq=False)
class Event:
    """The last operation of a stream at the time of recording."""

    operation: Operation | None = None


def perform(operation: Operation | None) -> None:
    """Run an operation, after all that it comes after."""
    stack = [operation] if operation is not None else []
    while stack:
        top = stack[-1]
        ahead = [before for before in top.after if not before.done] if not top.done else []
        if ahead:
            stack.extend(ahead)
            continue
        stack.pop()
        if not top.done:
            top.done = True
            top.after = []
            top.work()


class Streams:
    """All streams of a device; number 0 is the default stream, which waits for all and for which all wait.

    With ``late`` an operation runs only when it is waited for: whatever is not ordered by streams and events then comes
    in an order that the program did not mean.
    """

    def __init__(self, *, late: bool) -> None:
        self.late = late
        self.streams: dict[int, Stream] = {0: Stream()}
        self.current = 0

    def issue(self, number: int, work: Work) -> Operation | None:
        """Put work behind all that a stream has, or into the graph that it captures."""
        stream = self.streams[number]
        if stream.capture is not None:
            stream.capture.works.append(work)
            return None
        before = self.streams.values() if number == 0 else (stream, self.streams[0])
        after = [other.last for other in before if other.last is not None and not other.last.done]
        operation = Operation(work, [*after, *stream.waits])
        stream.waits = []
        stream.last = operation
        if not self.late:
            perform(operation)
        return operation

    def capturing(self) -> bool:
        """Tell whether any stream captures."""
        return any(stream.capture is not None for stream in self.streams.values())

    def refuse_in_capture(self, what: str) -> None:
        """Raise RuntimeError where a stream captures: CUDA's own answer to ``what``."""
        if self.capturing():
            raise RuntimeError(f"{what} is not permitted while a stream captures")

    def record(self, event: Event, number: int) -> None:
        """Let an event stand for all that a stream has."""
        self.refuse_in_capture("recording an event for work outside the graph")
        event.operation = self.issue(number, lambda: None)

    def wait(self, number: int, event: Event) -> None:
        """Let what comes to a stream come after an event."""
        if self.streams[number].capture is not None:
            raise RuntimeError("a stream that captures waits for work outside the graph")
        if event.operation is not None and not event.operation.done:
            self.streams[number].waits.append(event.operation)

    def synchronize(self, number: int | None = None) -> None:
        """Run all that a stream has, or all streams."""
        self.refuse_in_capture("waiting for the device")
        for stream in [self.streams[number]] if number is not None else list(self.streams.values()):
            for operation in [*stream.waits, stream.last]:
                perform(operation)

    def finish(self, operation: Operation | None) -> None:
        """Run an operation, and what it comes after."""
        perform(operation)

    def begin_capture(self, number: int) -> None:
        """Let a stream record instead of run."""
        self.streams[number].capture = Graph()

    def end_capture(self, number: int) -> Graph:
        """Return what a stream recorded."""
        graph = self.streams[number].capture
        assert graph is not None, "a capture was begun"
        self.streams[number].capture = None
        return graph

    def launch(self, graph: Graph, number: int) -> None:
        """Issue what a graph recorded."""

        def work() -> None:
            for piece in graph.works:
                piece()

        self.issue(number, work)
