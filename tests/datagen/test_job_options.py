"""What programs that start ours rely on: progress by lines of JSON, and an end with their own."""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from datagen.blender_program import PROGRAM_VARIABLE, module_command
from datagen.progress import as_json_lines

WAITING = """
import signal, sys, threading, time
from datagen.parent_process import end_with_input
if sys.argv[2] == "background":  # where shells have programs ignore interrupts
    signal.signal(signal.SIGINT, signal.SIG_IGN)
end_with_input()
print("ready", flush=True)
try:
    threading.Event().wait() if sys.argv[1] == "lock" else time.sleep(60)
except KeyboardInterrupt:
    sys.exit(77)
"""


def test_progress_is_one_object_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    advance = as_json_lines("Rendering", 2)
    advance()
    advance()
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert lines == [{"stage": "Rendering", "done": done, "total": 2} for done in (0, 1, 2)]


@pytest.mark.parametrize(
    ("waiting_for", "ground"), [("lock", "foreground"), ("time", "foreground"), ("lock", "background")]
)
def test_the_end_of_the_input_interrupts(waiting_for: str, ground: str) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", WAITING, waiting_for, ground], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        time.sleep(0.1)
        assert process.poll() is None
        process.stdin.close()
        assert process.wait(timeout=5) == 77


def test_the_input_is_kept_from_processes_that_are_started() -> None:
    """One that had it too would take it away, and on Windows wait for it before its first line."""
    code = (
        "import subprocess, sys; from datagen.parent_process import end_with_input; end_with_input(); "
        "sys.exit(subprocess.run([sys.executable, '-c', 'import sys; sys.exit(len(sys.stdin.read()))'],"
        " timeout=10).returncode)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.wait(timeout=20) == 0


def test_the_command_line_ends_with_its_input(tmp_path: Path) -> None:
    """As where the program that holds the pipe's other end dies: what was rendered is kept."""
    command = [sys.executable, "-m", "datagen", "render", "suzanne", str(tmp_path / "out"), "--size", "64x48"]
    done = subprocess.run(
        [*command, "--samples", "1", "--frames", "500", "--progress", "json", "--end-with-input"],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 130, done.stderr
    assert "interrupted" in done.stderr


def test_a_blender_application_runs_a_module(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(PROGRAM_VARIABLE, raising=False)
    assert module_command("a.b", "c") == [sys.executable, "-m", "a.b", "c"]
    monkeypatch.setenv(PROGRAM_VARIABLE, "/opt/blender/blender")
    command = module_command("a.b", "c")
    assert command[0] == "/opt/blender/blender"
    assert command[-3:] == ["--", "a.b", "c"]
    assert "--factory-startup" in command


def test_what_blender_is_given_to_run_runs_the_module(monkeypatch: pytest.MonkeyPatch) -> None:
    """The expression finds the module behind the two dashes, as in Blender's own list of arguments."""
    monkeypatch.setenv(PROGRAM_VARIABLE, "blender")
    command = module_command("json.tool", "--help")
    expression = command[command.index("--python-expr") + 1]
    done = subprocess.run(
        [sys.executable, "-c", expression, *command[command.index("--") :]],
        capture_output=True,
        text=True,
        timeout=20,
        check=False,
    )
    assert done.returncode == 0
    assert "json" in done.stdout.lower()


def test_exr_files_are_read_by_another_process_as_by_this_one(tmp_path: Path) -> None:
    """As in a Blender application, where the module OpenEXR must not be loaded."""
    OpenEXR = pytest.importorskip("OpenEXR")  # noqa: N806
    from datagen.blender.exr_process import end_reader, read_file
    from datagen.blender.exr_reader import read_file as read_here

    channels = {name: np.random.default_rng(0).random((4, 5), dtype=np.float32) for name in ("View.Depth.Z", "A")}
    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
    image = tmp_path / "Bild für\nzwei.exr"
    OpenEXR.File(header, dict(channels)).write(str(image))
    here = read_here(image)
    for _ in range(2):
        there = read_file(image)
        assert there.keys() == here.keys()
        for name, channel in channels.items():
            np.testing.assert_array_equal(there[name], channel)
    assert list(tmp_path.iterdir()) == [image]
    with pytest.raises(RuntimeError, match=r"none\.exr: "):
        read_file(tmp_path / "none.exr")
    (process,) = (child for child in psutil.Process().children() if "exr_reader" in " ".join(child.cmdline()))
    process.kill()
    process.wait(10)
    with pytest.raises(RuntimeError, match="the process that reads EXR files ended"):
        read_file(image)
    assert read_file(image).keys() == here.keys()
    end_reader()
    assert not [child for child in psutil.Process().children() if "exr_reader" in " ".join(child.cmdline())]
