"""Rendering processes: Blender's crashes, noise and memory stay outside the process that the user sees.

A worker is told its next task when it has rendered the last one, whose files it still writes then. One that dies
takes two frames along, no more, and they are given to a fresh worker once. A worker that has rendered many frames, or
has grown, is let go and followed by a fresh one.
"""

import contextlib
import json
import queue
import shutil
import subprocess
import tempfile
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import psutil

from datagen.blender_program import module_command, module_environment
from datagen.dataset_format import METADATA_FILE
from datagen.errors import InputError, WorkerError
from datagen.rendering.scratch import hold, make_scratch
from datagen.scene_spec.scene import Scene

WORKER_MODULE = "datagen.blender.worker"
LOG_TAIL_BYTES = 2000
BYTES_PER_PIXEL = 4 * 14
"""Of what Blender hands over a frame in single precision: two images of red, green, blue, alpha, depth and index (one
waits to be written), each noisy and clean where it is denoised."""
FRAMES_PER_WORKER = 1000
MEMORY_GROWTH = 1.5
MEMORY_GRACE_BYTES = 256 * 2**20
SETTLED_FRAMES = 3
"""A worker is replaced when its memory is MEMORY_GROWTH times what it was after so many frames, and the grace more."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """What is rendered, where to, and on what; ``threads`` for each worker, 0 for all cores.

    A worker is replaced after ``frames_per_worker`` frames.
    """

    scene: Scene
    folder: Path
    device: str
    threads: int = 0
    require_gpu: bool = False
    frames_per_worker: int = FRAMES_PER_WORKER


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
    """One worker process, its log, the task that it renders and the one whose files it writes (None: no such)."""

    def __init__(self, job: Job, inbox: "queue.Queue[tuple[RenderWorker, str]]") -> None:
        self.rendering: Task | None = None
        self.writing: Task | None = None
        self.retired = False
        self._job = job
        self._rendered = 0
        self._settled_bytes = 0
        width, height = job.scene.render.size
        self._open = contextlib.ExitStack()
        self._scratch = make_scratch(width * height * BYTES_PER_PIXEL)
        self._open.enter_context(hold(self._scratch))
        self._log = self._open.enter_context(tempfile.TemporaryFile("w+b"))  # noqa: SIM115 - that closes it
        self._process = subprocess.Popen(  # noqa: S603 - our own module
            module_command(WORKER_MODULE, str(self._scratch)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            encoding="utf-8",
            env=module_environment(self._scratch),
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
                "require_gpu": job.require_gpu,
                # Once a dataset is begun, its path has been found to be good.
                "check_path": not (job.folder / METADATA_FILE).is_file(),
            }
        )

    @property
    def in_hand(self) -> list[Task]:
        """The tasks that end with the worker if it dies now, the earlier first."""
        return [task for task in (self.writing, self.rendering) if task is not None]

    def assign(self, task: Task) -> None:
        """Tell the worker to begin ``task``."""
        self.rendering = task
        self._send({"kind": task.kind, "frame": task.frame, "folder": str(self._job.folder)})

    def note_rendered(self) -> None:
        """Take note that the worker has rendered its task and writes the files now."""
        self.writing, self.rendering = self.rendering, None
        self._rendered += 1
        if self._rendered == SETTLED_FRAMES:
            self._settled_bytes = self._memory_bytes()

    def is_worn_out(self) -> bool:
        """Tell whether a fresh worker should follow: many frames rendered, or memory that grows."""
        if self._rendered >= self._job.frames_per_worker:
            return True
        bound = self._settled_bytes * MEMORY_GROWTH + MEMORY_GRACE_BYTES
        return self._rendered > SETTLED_FRAMES and self._memory_bytes() > bound

    def retire(self) -> None:
        """Let the worker finish what it has in hand and end."""
        self.retired = True
        with contextlib.suppress(BrokenPipeError):
            assert self._process.stdin is not None
            self._process.stdin.close()

    def note_done(self) -> Task:
        """Take note that the files are there, and return the task that is done with that."""
        assert self.writing is not None
        done, self.writing = self.writing, None
        return done

    def complaint(self, report: dict[str, Any] | None) -> str:
        """Say what failed and how, by a report of failure, or for None, by the end of the process."""
        blamed = self.rendering or self.writing
        if report is not None:
            task = report.get("task")
            blamed = self.writing if task is not None else blamed
            reason = report["error"]
        else:
            status = self._process.wait()
            how = f"signal {-status}" if status < 0 else f"exit code {status}"
            reason = f"the rendering process ended unexpectedly ({how})"
        return f"{blamed if blamed is not None else 'starting Blender'}: {reason}"

    def failure(self, report: dict[str, Any] | None) -> InputError | WorkerError:
        """Return the error that stands for a report of failure, or for None, for the end of the process."""
        if report is not None and report["input_error"]:
            return InputError(report["error"])
        return WorkerError(
            f"{self.complaint(report)}; finished frames are kept and the same command goes on from there. "
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
        shutil.rmtree(self._scratch, ignore_errors=True)
        self._open.close()

    def _memory_bytes(self) -> int:
        try:
            return int(psutil.Process(self._process.pid).memory_info().rss)
        except psutil.Error:
            return 0

    def _send(self, message: dict[str, Any]) -> None:
        assert self._process.stdin is not None
        # A worker that has died is noticed by the end of its reports, where its task is known.
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(message) + "\n")
            self._process.stdin.flush()

    def _forward_reports(self, inbox: "queue.Queue[tuple[RenderWorker, str]]") -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):  # a Blender application says its name first
                inbox.put((self, line))
        inbox.put((self, ""))

    def _log_tail(self) -> str:
        self._log.seek(0)
        return self._log.read()[-LOG_TAIL_BYTES:].decode(errors="replace").strip() or "(nothing)"
