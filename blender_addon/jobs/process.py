"""One process: started with its output in files, looked at without waiting, ended with Blender."""

import contextlib
import json
import os
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

from ..errors import ReconstructionError

GRACE_SECONDS = 30.0
"""How long a process that was told to end may take to leave all in order."""
LAST_SECONDS = 2.0
"""How long it may take when Blender itself ends, or the extension is taken away."""
PIECE_BYTES = 1 << 16


class Process:
    """A running command. Its standard input is a pipe that ends when Blender does, however that ends."""

    def __init__(self, line: Sequence[str], *, folder: Path, name: str, environment: dict[str, str]) -> None:
        """Start ``line``; its output goes to ``name``.json and ``name``.log in ``folder``."""
        self.log_file = folder / f"{name}.log"
        self._answer_file = folder / f"{name}.json"
        self._told_to_end: float | None = None
        with self._answer_file.open("wb") as answer, self.log_file.open("wb") as log:
            self._process = subprocess.Popen(  # noqa: S603 - our own command
                list(line),
                stdin=subprocess.PIPE,
                stdout=answer,
                stderr=log,
                cwd=folder,
                env=environment,
                start_new_session=True,
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
            )
        try:
            self._log: BinaryIO = self.log_file.open("rb")
        except OSError:
            self._process.kill()
            self._process.communicate()
            raise

    @property
    def pid(self) -> int:
        """The process's number."""
        return self._process.pid

    def read_new(self) -> bytes:
        """Return what it wrote to its log since the last call, a piece of it where that is much."""
        return self._log.read(PIECE_BYTES)

    def poll(self) -> int | None:
        """Return its exit code, None while it runs; one that was told to end and does not is killed in the end."""
        if self._told_to_end is not None and time.monotonic() - self._told_to_end > GRACE_SECONDS:
            self._process.kill()
        return self._process.poll()

    def interrupt(self) -> None:
        """Tell it to end by ending its input; it finishes or takes back what it has in hand."""
        if self._told_to_end is None:
            self._told_to_end = time.monotonic()
            self._close_input()

    def end(self) -> None:
        """End it, if it still runs, and let go of its files.

        It is told first, so that it can end the processes that render for it: killed at once it would leave them to
        see for themselves, after the frame that they are at.
        """
        self._close_input()
        try:
            self._process.wait(LAST_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._log.close()

    def answer(self) -> Any:
        """Return what it printed, JSON, or None where it printed nothing."""
        text = self._answer_file.read_text(encoding="utf-8", errors="replace").strip()
        try:
            return json.loads(text) if text else None
        except ValueError:
            raise ReconstructionError(f"{self._answer_file}: not the JSON that was expected") from None

    def _close_input(self) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()


def signal_name(exit_code: int) -> str:
    """Say how a process ended that did not end by itself."""
    if exit_code >= 0 or os.name == "nt":
        return f"with exit code {exit_code}"
    return (
        "by the system or by hand (it was killed; perhaps memory ran out)"
        if exit_code == -9
        else (f"by signal {-exit_code}")
    )
