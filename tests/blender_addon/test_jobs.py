"""Jobs: how far they are, and what they say of what went wrong."""

import errno
from pathlib import Path

import bpy
import pytest

from blender_addon.errors import ReconstructionError
from blender_addon.jobs import runner
from blender_addon.jobs.command import Command
from blender_addon.jobs.job import Job, Pace, State, Work
from blender_addon.jobs.progress import ProcessLog, Progress


def test_progress_and_log_are_told_apart_however_the_stream_is_cut() -> None:
    now = [100.0]
    first, second = (b'{"stage": "Rendering", "done": %d, "total": 4}\n' % done for done in (0, 1))
    text = b"hello\n" + first + b'{"not": 1}\n\n' + second + b"bye\n"
    for size in (1, 7, 1000):
        log = ProcessLog(clock=lambda: now[0])
        for start in range(0, len(text), size):
            log.feed(text[start : start + size])
        now[0] += 10
        assert list(log.lines) == ["hello", '{"not": 1}', "bye"]
        assert log.progress == Progress(stage="Rendering", done=1, total=4, seconds=10)


def test_the_time_left_is_that_of_the_steps_so_far() -> None:
    progress = Progress(stage="rendering", done=15, total=60, seconds=30)
    assert progress.seconds_left == 90
    assert progress.describe() == "Rendering 15/60, 1:30 left"
    assert Progress(stage="x", done=0, total=60, seconds=3).seconds_left is None
    assert Progress(stage="x", done=0, total=0, seconds=3).fraction == 0


@pytest.mark.usefixtures("extension")
def test_a_program_that_refuses_is_reported_in_its_own_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With every letter, whatever the locale: on Windows programs speak that of the country."""
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    none = tmp_path / "Größe ☃"

    def work(job: Job) -> Work[str]:
        arguments = ("sensor", str(none), "--model", "kinect-v1")
        yield from job.run(Command(program="datagen", arguments=arguments, failure="No noise"))
        return "simulated"

    job = runner.run_to_end("Simulate", work)
    assert job.state is State.FAILED
    assert job.message == f"No noise: {none}: no such folder; name the folder of a dataset"
    assert runner.current_job() is None
    assert runner.last_job() is job
    assert not job.folder.exists()


@pytest.mark.usefixtures("extension")
def test_an_error_of_ours_is_reported_and_the_next_job_can_begin() -> None:
    def work(job: Job) -> Work[str]:
        yield Pace.MORE
        raise ZeroDivisionError("oops")

    job = runner.run_to_end("Test", work)
    assert job.state is State.FAILED
    assert "ZeroDivisionError: oops" in job.message
    assert any("Traceback" in line for line in job.log.lines)

    def fine(job: Job) -> Work[str]:
        value = yield from job.in_thread(lambda: 6 * 7)
        return f"done: {value}"

    assert runner.run_to_end("Test", fine).message == "done: 42"


@pytest.mark.usefixtures("extension")
def test_one_job_at_a_time() -> None:
    def endless(job: Job) -> Work[str]:
        while True:
            yield Pace.WAIT

    job = runner.start("First", endless)
    with pytest.raises(ReconstructionError, match="First is still running"):
        runner.start("Second", endless)
    with pytest.raises(RuntimeError, match="First is running"):
        bpy.ops.scanback.estimate()
    runner.end_all()
    assert job.state is State.CANCELLED
    assert runner.current_job() is None


@pytest.mark.usefixtures("extension")
@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "the disk is full; free some space"),
        (PermissionError(errno.EACCES, "Permission denied", "/there"), "/there: Permission denied; choose another"),
        (OSError(errno.EIO, "Input/output error", "/there"), "Test: /there: Input/output error"),
    ],
)
def test_what_the_system_refuses_blender_itself_is_told_with_its_remedy(error: OSError, words: str) -> None:
    def work(job: Job) -> Work[str]:
        yield Pace.MORE
        raise error

    job = runner.run_to_end("Test", work)
    assert job.state is State.FAILED
    assert words in job.message
    assert "Error(" not in job.message


def _nothing(job: Job) -> Work[str]:
    yield Pace.WAIT
    return ""


@pytest.mark.usefixtures("extension")
def test_without_a_place_for_its_files_a_job_does_not_begin(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ReconstructionError, match="cannot be written"):
        Job("Scan", _nothing, cache=tmp_path / "file" / "jobs")
