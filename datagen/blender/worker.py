"""A process that renders what it is told to: ``python -m datagen.blender.worker SCRATCH``.

Standard input brings one JSON object a line: first the job, then one task each. Standard output gives JSON lines and
nothing else: one with ``ready`` for the job; for each task one with ``rendered``, when the next task may come, and one
with ``done``, when its files are there. What Blender prints goes to standard error. A frame's files are written while
the next frame renders, and no more than one frame waits. The end of standard input ends the process when it has done
what it was told; the death of its parent ends it at once, whatever it renders. It removes its SCRATCH folder then, so
that nothing is left behind.
"""

import contextlib
import json
import os
import shutil
import sys
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from datagen.errors import InputError
from datagen.parent_process import end_with_parent
from datagen.rendering.scratch import hold
from datagen.scene_spec.scene import Scene

if TYPE_CHECKING:
    from datagen.blender.session import RenderSession


class Reports:
    """The pipe to the parent; two threads write to it."""

    def __init__(self) -> None:
        """Claim standard output, and send all that Blender's libraries print to standard error instead."""
        self._pipe: TextIO = os.fdopen(os.dup(1), "w", encoding="utf-8")
        self._lock = threading.Lock()
        os.dup2(2, 1)

    def send(self, report: dict[str, Any]) -> None:
        """Write one line."""
        with self._lock:
            self._pipe.write(json.dumps(report) + "\n")
            self._pipe.flush()


def main() -> int:
    """Serve one parent until it closes standard input; returns the exit code."""
    reports = Reports()
    scratch = Path(sys.argv[1])
    try:
        with hold(scratch):
            return _serve(reports, scratch)
    except BrokenPipeError:
        return 0  # the parent died; what was being written is whole all the same
    except Exception as error:
        return _fail(reports, error)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _serve(reports: Reports, scratch: Path) -> int:
    first_line = sys.stdin.readline()
    if not first_line:
        return 0
    session = _open_session(json.loads(first_line), scratch)
    reports.send({"ready": session.description()})
    with ThreadPoolExecutor(max_workers=1) as writer:
        end_with_parent(partial(_leave_in_order, writer, scratch))
        being_written: list[Future[None]] = []
        for line in sys.stdin:
            task = json.loads(line)
            write = _perform(session, task)
            wait(being_written)
            reports.send({"rendered": task})
            being_written = [writer.submit(_finish, write, reports, task)]
    return 0


def _leave_in_order(writer: ThreadPoolExecutor, scratch: Path) -> None:
    """Let the files that are being written become whole, and remove what else there is."""
    writer.shutdown()
    shutil.rmtree(scratch, ignore_errors=True)


def _open_session(job: dict[str, Any], scratch: Path) -> "RenderSession":
    try:
        from datagen.blender.session import RenderSession  # noqa: PLC0415 - what is missing is said to the parent
    except ModuleNotFoundError as error:
        raise InputError(
            f'rendering needs the Python module {error.name}, which is not installed: pip install "scanback[blender]"'
        ) from error
    except ImportError as error:
        raise InputError(
            f"Blender cannot be loaded, a system library is missing ({error}); on Debian or Ubuntu: apt-get install "
            "libx11-6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libgl1"
        ) from error
    session = RenderSession(
        Scene.model_validate_json(job["scene"]),
        device=job["device"],
        threads=job["threads"],
        scratch=scratch,
        require_gpu=job["require_gpu"],
    )
    if job["check_path"]:
        session.check_path()
    return session


def _perform(session: "RenderSession", task: dict[str, Any]) -> Callable[[], None]:
    """Do what needs Blender, and return what is left to do: writing a frame's files."""
    folder = Path(task["folder"])
    if task["kind"] == "ground_truth":
        session.write_ground_truth(folder)
        return lambda: None
    return partial(session.write, folder, session.render(task["frame"]))


def _finish(write: Callable[[], None], reports: Reports, task: dict[str, Any]) -> None:
    """Write and report, also failure: the parent ends this process then, whatever it renders meanwhile."""
    try:
        write()
        reports.send({"done": task})
    except Exception as error:
        _fail(reports, error, task)


def _fail(reports: Reports, error: Exception, task: dict[str, Any] | None = None) -> int:
    is_input_error = isinstance(error, InputError)
    if not is_input_error:
        traceback.print_exception(error)
    message = str(error) if is_input_error else f"{type(error).__name__}: {error}"
    with contextlib.suppress(BrokenPipeError):
        reports.send({"error": message, "input_error": is_input_error, "task": task})
    return 1


if __name__ == "__main__":
    status = main()
    sys.stderr.flush()
    # All is tidied up; Blender 4.5 as a module may wait for a thread of its own for ever when Python ends in order.
    os._exit(status)
