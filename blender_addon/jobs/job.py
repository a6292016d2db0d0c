"""A job: work that goes on in small steps until it is done, fails or is cancelled."""

import errno
import shutil
import threading
import traceback
from collections.abc import Callable, Generator
from dataclasses import dataclass
from enum import Enum
from itertools import takewhile
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from ..errors import ReconstructionError
from .command import Command, environment
from .job_folder import JobFolder
from .process import Process, signal_name
from .progress import ProcessLog, Progress

_Result = TypeVar("_Result")

FULL_BYTES = 1 << 16
"""A disk with less room than this is full."""
NOT_MEANT = ("Exception ignored", "Traceback")
"""How lines begin that Python prints as it ends, and which are not part of what was said."""
NOT_ALLOWED = (errno.EACCES, errno.EPERM, errno.EROFS)


class Pace(Enum):
    """What a step of work tells: whether it waits for something, or has more to do at once."""

    WAIT = 0
    MORE = 1


Work: TypeAlias = Generator[Pace, None, _Result]
"""Work in small steps, none of which takes long, and its result."""


class State(Enum):
    """Where a job is."""

    RUNNING = "running"
    CANCELLING = "cancelling"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


class CancelledError(Exception):
    """The user cancelled the job."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a job, in words for the user."""

    state: State
    message: str


class Job:
    """One job with its folder for files that nobody needs afterwards. ``work`` gets the job itself."""

    def __init__(self, title: str, work: "Callable[[Job], Work[str]]", *, cache: Path) -> None:
        """Begin; ``work`` returns the sentence that tells what was done. Raises ReconstructionError without a place."""
        self.title = title
        self.state = State.RUNNING
        self.message = ""
        self.log = ProcessLog()
        self._place = JobFolder(cache)
        self.folder = self._place.path
        self._process: Process | None = None
        self._count = 0
        self._work = work(self)

    @property
    def is_over(self) -> bool:
        """Tell whether nothing more will happen."""
        return self.state in (State.DONE, State.FAILED, State.CANCELLED)

    @property
    def progress(self) -> Progress | None:
        """How far the present stage is."""
        return self.log.progress

    @property
    def pid(self) -> int | None:
        """The number of the process that runs now, None where none does."""
        return self._process.pid if self._process is not None else None

    def step(self) -> Pace:
        """Do the next piece of work; failure and success are told by ``state`` and ``message``."""
        try:
            return next(self._work)
        except StopIteration as stop:
            self._finish(State.DONE, stop.value)
        except CancelledError as cancelled:
            self._finish(State.CANCELLED, str(cancelled))
        except ReconstructionError as error:
            self._finish(State.FAILED, str(error))
        except OSError as error:
            self._finish(State.FAILED, self._refusal(error))
        except Exception as error:
            self.log.lines.extend(traceback.format_exc().splitlines())
            self._finish(State.FAILED, f"{self.title}: unexpected error ({type(error).__name__}: {error}); see the log")
        return Pace.WAIT

    def cancel(self) -> None:
        """Ask for an end; it comes some steps later, when what is in hand was left in order."""
        if self.state is State.RUNNING:
            self.state = State.CANCELLING

    def kill(self) -> None:
        """End all at once."""
        self._work.close()
        if not self.is_over:
            self._finish(State.CANCELLED, f"{self.title}: ended")

    def run(self, command: Command, *, meanwhile: Callable[[], None] = lambda: None) -> "Work[Any]":
        """Run a command, with ``meanwhile`` at every step, and return the JSON that it prints with --json."""
        self._check_cancelled()
        self._count += 1
        name = f"{self._count}-{command.arguments[0]}"
        process = self._process = Process(command.line(), folder=self.folder, name=name, environment=environment())
        try:
            while (exit_code := process.poll()) is None:
                if self.state is State.CANCELLING:
                    process.interrupt()
                self.log.feed(process.read_new())
                meanwhile()
                yield Pace.WAIT
            while data := process.read_new():
                self.log.feed(data)
            self._check_cancelled()
            if exit_code != 0:
                raise ReconstructionError(self._failure(command, exit_code))
            return process.answer() if "--json" in command.arguments else None
        finally:
            self._process = None
            process.end()

    def in_thread(self, function: Callable[[], _Result]) -> "Work[_Result]":
        """Call ``function``, which must not touch Blender, in a thread and return its result."""
        results: list[_Result] = []
        errors: list[BaseException] = []

        def call() -> None:
            try:
                results.append(function())
            except BaseException as error:  # it is raised again where the job sees it
                errors.append(error)

        thread = threading.Thread(target=call, name=self.title, daemon=True)
        thread.start()
        while thread.is_alive():
            yield Pace.WAIT
        self._check_cancelled()
        if errors:
            raise errors[0]
        return results[0]

    def _check_cancelled(self) -> None:
        if self.state is State.CANCELLING:
            raise CancelledError(f"{self.title}: cancelled")

    def _failure(self, command: Command, exit_code: int) -> str:
        """Return what the program said last of an error, without its name, or how it ended."""
        marker = f"{command.program}: error: "
        self.log.end()
        lines = list(self.log.lines)
        said = [i for i, line in enumerate(lines) if line.startswith(marker)]
        if said:
            more = takewhile(lambda line: not line.startswith(NOT_MEANT), lines[said[-1] + 1 :][:3])
            return f"{command.failure}: {' '.join([lines[said[-1]].removeprefix(marker), *more])}"
        if self._is_full():
            return f"{command.failure}: {self._full()}"
        if lines and exit_code == 1:
            return f"{command.failure}: it ended unexpectedly ({lines[-1]}); see the log"
        return f"{command.failure}: the process was ended {signal_name(exit_code)}; run it again"

    def _refusal(self, error: OSError) -> str:
        """Say what the system refused to do in Blender itself, of which file, and what helps."""
        if error.errno == errno.ENOSPC or (error.errno is None and self._is_full()):
            return f"{self.title}: {self._full()}"
        reason = f"{error.filename or self.folder}: {error.strerror or error}"
        remedy = "; choose another folder, or change its permissions" if error.errno in NOT_ALLOWED else ""
        return f"{self.title}: {reason}{remedy}"

    def _is_full(self) -> bool:
        try:
            return shutil.disk_usage(self.folder).free < FULL_BYTES
        except OSError:
            return False

    def _full(self) -> str:
        cache = self.folder.parent
        return f"{cache}: the disk is full; free some space, or choose another cache folder in preferences"

    def _finish(self, state: State, message: str) -> None:
        self.state, self.message = state, message
        self._place.remove()
