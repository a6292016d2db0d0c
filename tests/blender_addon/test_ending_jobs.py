"""However a job or Blender ends: no process outlives it, and what was made can be gone on with."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import psutil
import pytest
from tick_time import timing_ticks

import blender_addon
from blender_addon.jobs import runner
from blender_addon.jobs.command import Command
from blender_addon.jobs.job import Job, Pace, State, Work
from blender_addon.settings import FuseProperties
from blender_addon.steps.fuse import fuse_work
from blender_addon.steps.scene_reference import remember
from datagen.dataset_format import GROUND_TRUTH_FILE

PATIENCE_SECONDS = 300.0
"""Far more than anything here takes, also where the machine does much else."""
LONG, SHORTER = 500, 200
"""Frames of a scan that is interrupted: rendering the rest takes far longer than it takes to see the first."""


def _finish(job: Job, *, seconds: float = PATIENCE_SECONDS) -> float:
    """Advance a job to its end as the timer does; returns the longest tick in seconds of the processor."""
    end = time.monotonic() + seconds
    with timing_ticks() as ticks:
        while not job.is_over:
            assert time.monotonic() < end, list(job.log.lines)
            pace = ticks.of(runner.advance)
            time.sleep(0.02 if pace is Pace.WAIT else 0)
    return ticks.longest


def _wait_until(is_so: Callable[[], bool], *, seconds: float = PATIENCE_SECONDS) -> bool:
    end = time.monotonic() + seconds
    while not is_so() and time.monotonic() < end:
        time.sleep(0.05)
    return is_so()


def _render(folder: Path, frames: int, *, size: str = "64x48", samples: int = 1) -> Command:
    options = ("--frames", str(frames), "--size", size, "--samples", str(samples))
    return Command(program="datagen", arguments=("render", "suzanne", str(folder), *options), failure="No frames")


def _rendering(folder: Path, frames: int = LONG) -> Callable[[Job], Work[str]]:
    def work(job: Job) -> Work[str]:
        yield from job.run(_render(folder, frames))
        return "rendered"

    return work


@pytest.mark.usefixtures("extension")
def test_cancelling_leaves_a_scan_that_can_be_gone_on_with(tmp_path: Path) -> None:
    folder = tmp_path / "dataset"
    job = runner.start("Scan", _rendering(folder))
    frames = folder / "frames"
    with timing_ticks() as ticks:
        while not (frames.is_dir() and any(frames.glob("*.pose.txt"))):
            ticks.of(runner.advance)
            time.sleep(0.02)
            assert not job.is_over, job.message
    assert job.pid is not None
    family = [psutil.Process(job.pid), *psutil.Process(job.pid).children(recursive=True)]
    assert len(family) >= 2
    assert bpy.ops.scanback.cancel() == {"FINISHED"}
    longest = max(ticks.longest, _finish(job))
    assert job.state is State.CANCELLED
    assert longest < 0.05
    assert _wait_until(lambda: not any(_lives(process) for process in family))
    whole = {path.name.split(".")[0] for path in frames.glob("*.pose.txt")}
    assert len(whole) < LONG
    for name in whole:
        assert (frames / f"{name}.color.png").is_file()
        assert (frames / f"{name}.depth.png").is_file()
    assert not list(folder.rglob(".unfinished*"))
    assert not (folder / ".rendering.lock").exists(), list(job.log.lines)


@pytest.mark.usefixtures("extension")
def test_a_job_that_is_killed_is_reported_and_the_panel_usable_again(tmp_path: Path) -> None:
    job = runner.start("Scan", _rendering(tmp_path / "dataset"))
    while job.pid is None:
        runner.advance()
    os.kill(job.pid, signal.SIGKILL)
    _finish(job)
    assert job.state is State.FAILED
    assert job.message.startswith("No frames: the process was ended by the system or by hand (it was killed; ")
    assert job.message.endswith("run it again")
    assert bpy.ops.scanback.dismiss() == {"FINISHED"}
    assert runner.last_job() is None


def _render_some(folder: Path, more: int) -> tuple[Job, list[psutil.Process]]:
    """Begin a scan, or go on with it, until there are so many frames more; returns it with its processes."""
    before = len(list(folder.glob("frames/*.pose.txt")))
    job = runner.start("Scan", _rendering(folder, frames=SHORTER))
    while len(list(folder.glob("frames/*.pose.txt"))) < before + more:
        runner.advance()
        time.sleep(0.02)
        assert not job.is_over, job.message
    assert job.pid is not None
    family = [psutil.Process(job.pid), *psutil.Process(job.pid).children(recursive=True)]
    assert len(family) >= 2
    return job, family


@pytest.mark.slow
def test_a_scan_whose_processes_are_ended_in_any_way_is_gone_on_with(empty_scene: Any, tmp_path: Path) -> None:
    folder = tmp_path / "dataset"

    def frames() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in folder.glob("frames/*.pose.txt")}

    blender_addon.register()
    job, family = _render_some(folder, 1)
    blender_addon.unregister()
    assert job.state is State.CANCELLED
    assert _wait_until(lambda: not any(_lives(process) for process in family))
    assert 0 < len(frames()) < SHORTER
    assert not list(folder.rglob(".unfinished*"))
    blender_addon.register()
    try:
        before = frames()
        job, family = _render_some(folder, 1)
        family[0].kill()
        _finish(job)
        assert job.state is State.FAILED
        assert _wait_until(lambda: not any(_lives(process) for process in family))
        assert len(frames()) < SHORTER
        job, family = _render_some(folder, 1)
        family[1].kill()  # what renders: another one takes its place
        assert _finish(job) < 0.05
        assert job.message == "rendered"
        assert any("a fresh process tries again" in line for line in job.log.lines)
        assert len(frames()) == SHORTER
        assert before.items() <= frames().items()
        assert not list(folder.rglob(".unfinished*"))
    finally:
        blender_addon.unregister()


@pytest.mark.slow
@pytest.mark.usefixtures("extension")
def test_what_renders_does_not_outlive_its_job_by_the_rest_of_a_frame(tmp_path: Path) -> None:
    folder = tmp_path / "dataset"

    def work(job: Job) -> Work[str]:
        yield from job.run(_render(folder, 1, size="1920x1080", samples=65536))  # it takes hours
        return "rendered"

    job = runner.start("Scan", work)
    while not (folder / GROUND_TRUTH_FILE).is_file():  # after it comes the frame
        runner.advance()
        time.sleep(0.02)
        assert not job.is_over, job.message
    assert job.pid is not None
    family = [psutil.Process(job.pid), *psutil.Process(job.pid).children(recursive=True)]
    renders = family[1]
    used = renders.cpu_times().user
    assert _wait_until(lambda: renders.cpu_times().user > used + 1)
    family[0].kill()
    _finish(job)
    assert job.state is State.FAILED
    assert _wait_until(lambda: not any(_lives(process) for process in family))


STARTS_A_JOB = """
import sys, time
from pathlib import Path
from typing import Any
import bpy, blender_addon
from blender_addon.jobs import runner
from blender_addon.jobs.command import Command

blender_addon.register()
folder = Path(sys.argv[1])

def work(job):
    arguments = ("render", "suzanne", str(folder), "--frames", sys.argv[2], "--size", "64x48", "--samples", "1")
    yield from job.run(Command(program="datagen", arguments=arguments, failure="x"))
    return ""

job = runner.start("Scan", work)
while not list(folder.glob("frames/*.pose.txt")):
    runner.advance()
    time.sleep(0.05)
    assert not job.is_over, job.message
print(job.pid, flush=True)
time.sleep(600)
"""


def test_no_process_outlives_blender(tmp_path: Path) -> None:
    """However Blender ends: here the hard way."""
    blender = subprocess.Popen(
        [sys.executable, "-c", STARTS_A_JOB, str(tmp_path / "dataset"), str(LONG)], stdout=subprocess.PIPE, text=True
    )
    assert blender.stdout is not None
    try:
        line = blender.stdout.readline()
        while not line.strip().isdecimal():
            assert line, "Blender ended by itself"
            line = blender.stdout.readline()
        job = psutil.Process(int(line))
        family = [job, *job.children(recursive=True)]
        assert len(family) >= 2
    finally:
        blender.kill()
        blender.wait()
        blender.stdout.close()
    assert _wait_until(lambda: not any(_lives(process) for process in family))
    assert len(list(tmp_path.glob("dataset/frames/*.pose.txt"))) < LONG


def _lives(process: psutil.Process) -> bool:
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


@pytest.mark.usefixtures("extension")
def test_taking_the_extension_away_ends_its_job(tmp_path: Path) -> None:
    job = runner.start("Scan", _rendering(tmp_path / "dataset"))
    while job.pid is None:
        runner.advance()
    process = psutil.Process(job.pid)
    blender_addon.unregister()
    try:
        assert not _lives(process)
        assert job.state is State.CANCELLED
        assert not job.folder.exists()
    finally:
        blender_addon.register()


@pytest.mark.slow
@pytest.mark.usefixtures("extension")
def test_a_job_goes_on_when_another_file_is_opened_and_its_result_is_kept(sphere_scan: Any, tmp_path: Path) -> None:
    scene = bpy.context.scene
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other.blend"))
    chosen = {name: getattr(scene.scanback.fuse, name) for name in FuseProperties.__annotations__}
    chosen |= {"device": "cpu", "voxel_size": 0.05}
    folder = tmp_path / "project"
    job = runner.start("Fuse", fuse_work(remember(scene), folder, sphere_scan.dataset, chosen))
    while job.pid is None or job.log.progress is None:
        runner.advance()
        time.sleep(0.02)
        assert not job.is_over, job.message
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "other.blend"))
    assert runner.current_job() is job
    _finish(job)
    assert job.state is State.FAILED
    assert "is not open any more; what was made is kept" in job.message
    assert (folder / "reconstruction" / "mesh.ply").is_file()
    assert not bpy.data.objects
    assert bpy.ops.scanback.import_reconstruction(directory=str(folder / "reconstruction")) == {"FINISHED"}
