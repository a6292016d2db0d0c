"""The workers of a render and the tasks that wait for them."""

import json
import queue
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from datagen.rendering.render_workers import Job, RenderWorker, Report, Task

ATTEMPTS = 2
"""How often a task may fail, or be in hand when its worker dies, before the render gives up."""


@contextmanager
def render_workers(
    job: Job, tasks: Sequence[Task], *, workers: int, tell: Callable[[str], None]
) -> Iterator[Iterator[Report]]:
    """Have processes do ``tasks``: the block gets their reports as they come, and when it is left they end.

    The reports raise InputError for what a worker refuses, and WorkerError, with the end of its log, for one that
    cannot start or a task that fails twice. The first failure of a task is said to ``tell``.
    """
    crew = Crew(job, tasks, tell)
    try:
        for _ in range(min(workers, len(tasks))):
            crew.hire()
        yield crew.reports()
    finally:
        crew.dismiss()


class Crew:
    """Workers, the tasks that wait, and how often each was tried in vain."""

    def __init__(self, job: Job, tasks: Sequence[Task], tell: Callable[[str], None]) -> None:
        self._job = job
        self._waiting = deque(tasks)
        self._unfinished = len(tasks)
        self._failures: Counter[Task] = Counter()
        self._tell = tell
        self._inbox: queue.Queue[tuple[RenderWorker, str]] = queue.Queue()
        self._workers: list[RenderWorker] = []

    def hire(self) -> None:
        """Start a worker, which gets a task when it is ready."""
        self._workers.append(RenderWorker(self._job, self._inbox))

    def dismiss(self) -> None:
        """End all workers at once."""
        for worker in self._workers:
            worker.stop()
        self._workers.clear()

    def reports(self) -> Iterator[Report]:
        """Yield that a worker is ready before it gets its first task, and each task when its files are there."""
        while self._unfinished:
            worker, line = self._inbox.get()
            if worker not in self._workers:
                continue  # replaced: the rest of what it had to say
            report = json.loads(line) if line else None
            if report is None or "error" in report:
                self._replace(worker, report)
            elif "ready" in report:
                yield Report(task=None, content=report["ready"])
                self._give_work(worker)
            elif "rendered" in report:
                worker.note_rendered()
                self._give_work(worker)
            else:
                self._unfinished -= 1
                yield Report(task=worker.note_done(), content={})
                self._give_work(worker)

    def _give_work(self, worker: RenderWorker) -> None:
        """Assign the next task, if there is one and the worker is free for it.

        A task that failed before is done alone: if it fails again, nothing else is lost with it.
        """
        if not self._waiting or worker.rendering is not None or worker.retired:
            return
        if worker.writing is not None and self._failures[self._waiting[0]]:
            return
        if worker.is_worn_out():
            worker.retire()
        else:
            worker.assign(self._waiting.popleft())

    def _replace(self, worker: RenderWorker, report: dict[str, Any] | None) -> None:
        """Let a fresh worker follow one that failed, died or was retired, and try again what it had in hand."""
        lost = worker.in_hand
        if lost or not worker.retired:
            self._failures.update(lost)
            refused = report is not None and report["input_error"]
            if refused or not lost or max(self._failures[task] for task in lost) >= ATTEMPTS:
                raise worker.failure(report)
            self._tell(f"{worker.complaint(report)}; a fresh process tries again")
        self._workers.remove(worker)
        worker.stop()
        self._waiting.extendleft(reversed(lost))
        if self._waiting:
            self.hire()
