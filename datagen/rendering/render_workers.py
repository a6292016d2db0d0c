"""Rendering processes: Blender's crashes, noise and memory stay outside the process that the user sees.

A worker is told one task at a time and reports when it is done, so that one that dies takes one frame along, no more.
"""

import contextlib
import json
import queue
import shutil
import subprocess
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from datagen.errors import InputError, WorkerError
from datagen.scene_spec.scene import Scene

WORKER_MODULE = "datagen.blender.worker"
LOG_TAIL_BYTES = 2000
MEMORY_FOLDER = Path("/dev/shm")  # noqa: S108 - only a subfolder of its own, made by tempfile, is used
BYTES_PER_PIXEL = 4 * 5
"""Of the image that Blender hands over: red, green, blue, alpha and depth in single precision."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """What is rendered, where to, and on what; ``threads`` for each worker, 0 for all cores."""

    scene: Scene
    folder: Path
    device: str
    threads: int = 0


@dataclass(frozen=True, kw_only=True)
class Task:
    """One thing that a worker is told to do."""

    kind: Literal["frame", "ground_truth"]
    frame: int = -1

    def __str__(self) -> str:
        return f"frame {self.frame}" if self.kind == "frame" else "the ground-truth mesh"


@dataclass(frozen=True, kw_only=True)
class Report:
    """A worker's word that it did ``task``, or for None that Blender is ready, with what it has to tell."""

    task: Task | None
    content: dict[str, Any]


class RenderWorker:
    """One worker process, its log, and the task that it has in hand (None: it is starting)."""

    def __init__(self, job: Job, inbox: "queue.Queue[tuple[RenderWorker, str]]") -> None:
        self.task: Task | None = None
        self._folder = job.folder
        self._scratch = tempfile.mkdtemp(prefix="scanback-", dir=_scratch_parent(job))
        self._log = tempfile.TemporaryFile("w+b")  # noqa: SIM115 - closed when the worker is stopped
        self._process = subprocess.Popen(  # noqa: S603 - our own module
            [sys.executable, "-m", WORKER_MODULE, self._scratch],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            encoding="utf-8",
            # Ctrl-C in a terminal reaches every process of its group; the parent alone is to answer it.
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._forward_reports, args=(inbox,), daemon=True)
        self._reader.start()
        self._send(
            {
                "scene": job.scene.model_dump_json(),
                "device": job.device,
                "threads": job.threads,
            }
        )

    def assign(self, task: Task) -> None:
        """Tell the worker to begin ``task``."""
        self.task = task
        self._send({"kind": task.kind, "frame": task.frame, "folder": str(self._folder)})

    def failure(self, report: dict[str, Any] | None) -> Exception:
        """Return the error that stands for a report of failure, or for None, the end of the process."""
        doing = str(self.task) if self.task is not None else "starting Blender"
        if report is not None and report["input_error"]:
            return InputError(report["error"])
        if report is not None:
            reason = report["error"]
        else:
            status = self._process.wait()
            how = f"signal {-status}" if status < 0 else f"exit code {status}"
            reason = f"the rendering process ended unexpectedly ({how})"
        return WorkerError(
            f"{doing}: {reason}; finished frames are kept and the same command goes on from there. "
            f"The last it printed:\n{self._log_tail()}"
        )

    def stop(self) -> None:
        """End the process at once and remove what it kept in memory; files of a dataset are whole or absent anyway."""
        self._process.kill()
        self._process.wait()
        self._reader.join()
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(BrokenPipeError):
                assert pipe is not None
                pipe.close()
        self._log.close()
        shutil.rmtree(self._scratch, ignore_errors=True)

    def _send(self, message: dict[str, Any]) -> None:
        assert self._process.stdin is not None
        # A worker that has died is noticed by the end of its reports, where its task is known.
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(message) + "\n")
            self._process.stdin.flush()

    def _forward_reports(self, inbox: "queue.Queue[tuple[RenderWorker, str]]") -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            inbox.put((self, line))
        inbox.put((self, ""))

    def _log_tail(self) -> str:
        self._log.seek(0)
        return self._log.read()[-LOG_TAIL_BYTES:].decode(errors="replace").strip() or "(nothing)"


@contextmanager
def render_workers(job: Job, tasks: Sequence[Task], *, workers: int) -> Iterator[Iterator[Report]]:
    """Have processes do ``tasks``: the block gets their reports as they come, and when it is left they end.

    The reports raise InputError for what a worker refuses, and WorkerError, with the end of its log, for one that
    fails or dies.
    """
    inbox: queue.Queue[tuple[RenderWorker, str]] = queue.Queue()
    crew: list[RenderWorker] = []
    try:
        for _ in range(min(workers, len(tasks))):
            crew.append(RenderWorker(job, inbox))
        yield _reports(tasks, inbox)
    finally:
        for worker in crew:
            worker.stop()


def _reports(tasks: Sequence[Task], inbox: "queue.Queue[tuple[RenderWorker, str]]") -> Iterator[Report]:
    """Yield each report before its worker gets the next task, so that the caller can act on it in time."""
    waiting = deque(tasks)
    unfinished = len(waiting)
    while unfinished:
        worker, line = inbox.get()
        content = json.loads(line) if line else None
        if content is None or "error" in content:
            raise worker.failure(content)
        yield Report(task=worker.task, content=content)
        unfinished -= worker.task is not None
        if waiting:
            worker.assign(waiting.popleft())


def _scratch_parent(job: Job) -> Path | None:
    """Return the memory-backed folder where it holds an image with room to spare (containers make it small)."""
    width, height = job.scene.render.size
    if not MEMORY_FOLDER.is_dir() or shutil.disk_usage(MEMORY_FOLDER).free < 3 * width * height * BYTES_PER_PIXEL:
        return None
    return MEMORY_FOLDER
