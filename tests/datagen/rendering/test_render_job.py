"""Whole renders through worker processes: what is on disk, whatever happens meanwhile."""

import contextlib
import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

import datagen
from datagen.errors import InputError, WorkerError
from datagen.open_dataset import open_dataset
from datagen.rendering import render_workers
from datagen.rendering.render_job import render_dataset

CHECKOUT = Path(datagen.__file__).parents[1]
FRAMES = 12

pytestmark = pytest.mark.usefixtures("blender")

SCENE_FILE = """
name = "killed"
[render]
frames = 12
size = [256, 192]
samples = 2
[materials.red]
color = "#c03020"
[[objects]]
name = "Suzanne"
shape = "suzanne"
material = "red"
scale = 0.3
[[lights]]
type = "sun"
position = [1, -2, 3]
power = 2
[[keyframes]]
time = 0
position = [-0.5, -2, 0.3]
look_at = [0, 0, 0]
[[keyframes]]
time = 1
position = [0.5, -2, 0.6]
look_at = [0, 0, 0]
"""


def command(scene, out, *more):
    return [sys.executable, "-m", "datagen", "render", str(scene), str(out), *more]


def run(arguments):
    return subprocess.run(arguments, cwd=CHECKOUT, capture_output=True, text=True, check=False, timeout=120)


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "killed.toml"
    path.write_text(SCENE_FILE)
    return path


@pytest.fixture(scope="module")
def uninterrupted(blender, scene_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("uninterrupted") / "dataset"
    done = run(command(scene_file, out))
    assert done.returncode == 0, done.stderr
    return out


def open_every_complete_frame(folder):
    """Read all that claims to be there; a torn file would raise."""
    if not (folder / "dataset.json").is_file():
        return 0
    dataset = open_dataset(folder)
    complete = [frame_id for frame_id in dataset.frame_ids if dataset.is_complete(frame_id)]
    for frame_id in complete:
        dataset.frame(frame_id)
    return len(complete)


def wait_for_frame(process, folder, frame):
    """Wait until ``frame`` frames are there."""
    frames = folder / "frames"
    while process.poll() is None:
        if frames.is_dir() and sum(name.endswith(".pose.txt") for name in os.listdir(frames)) >= frame:
            return


def stop_while_writing(process, workers, folder):
    """Stop the workers (SIGSTOP) at a moment at which a frame is half written, however seldom those are."""
    frames = folder / "frames"
    while process.poll() is None:
        if frames.is_dir() and len(os.listdir(frames)) % 3:
            signal_all(workers, signal.SIGSTOP)
            if half_written(folder):
                return
            signal_all(workers, signal.SIGCONT)


def signal_all(workers, number):
    for worker in workers:
        with contextlib.suppress(ProcessLookupError):  # it may just have finished its last frame
            os.kill(worker.pid, number)  # at once: psutil looks around first


def workers_of(process):
    """Wait for the rendering processes of a run and return them."""
    while process.poll() is None:
        with contextlib.suppress(psutil.NoSuchProcess):
            children = psutil.Process(process.pid).children()
            if workers := [child for child in children if "datagen.blender.worker" in child.cmdline()]:
                return workers
    return []


def test_a_render_killed_at_random_moments_resumes_to_the_same_bits(scene_file, uninterrupted, tmp_path):
    chance = random.Random(20241)
    out = tmp_path / "dataset"
    torn = 0
    for i, frame in enumerate([0, *sorted(chance.sample(range(1, FRAMES - 1), 2))]):
        with open(os.devnull, "w") as nowhere:
            process = subprocess.Popen(command(scene_file, out), cwd=CHECKOUT, stdout=nowhere, stderr=nowhere)
        workers = workers_of(process)
        if frame:
            wait_for_frame(process, out, frame)
        if i % 2 == 0:  # the writer too, at once; else it may finish its frame
            if frame:
                stop_while_writing(process, workers, out)
            signal_all(workers, signal.SIGKILL)
        else:
            time.sleep(chance.uniform(0, 0.1))
        process.kill()
        process.wait()
        _, alive = psutil.wait_procs(workers, timeout=20)
        assert not alive, "a worker outlived its parent"
        open_every_complete_frame(out)
        torn += bool(half_written(out))
    assert torn, "no kill came while a frame was being written: the test has lost its sting"
    done = run(command(scene_file, out))
    assert done.returncode == 0, done.stderr
    resumed, straight = contents(out), contents(uninterrupted)
    assert resumed.keys() == straight.keys()
    assert [name for name in straight if resumed[name] != straight[name]] == []


def half_written(folder):
    """Return the names of temporary files, and of files whose frame is not whole."""
    names = {path.name for path in (folder / "frames").glob("*")}
    whole = {name.split(".")[0] for name in names if name.endswith(".pose.txt")}
    return {name for name in names if name.split(".")[0] not in whole}


def test_several_workers_write_the_same_bits(scene_file, uninterrupted, tmp_path):
    done = run(command(scene_file, tmp_path / "dataset", "--workers", "2"))
    assert done.returncode == 0, done.stderr
    assert contents(tmp_path / "dataset") == contents(uninterrupted)


def test_a_lost_file_is_rendered_again_and_leftovers_are_removed(scene_file, uninterrupted):
    whole = contents(uninterrupted)
    (uninterrupted / "frames" / "frame-000003.depth.png").unlink()
    (uninterrupted / "ground_truth" / "mesh.ply").unlink()
    (uninterrupted / "frames" / ".unfinished-x.png").write_bytes(b"torn")
    done = run(command(scene_file, uninterrupted))
    assert done.returncode == 0, done.stderr
    assert contents(uninterrupted) == whole


def test_a_complete_dataset_returns_without_starting_blender(scene_file, uninterrupted, monkeypatch):
    from datagen.scene_spec.scene_files import read_scene

    monkeypatch.setattr(render_workers, "WORKER_MODULE", "no.such.module")
    assert len(render_dataset(read_scene(scene_file), uninterrupted).frame_ids) == FRAMES


def test_control_c_stops_the_workers_says_how_to_go_on_and_leaves_nothing_torn(scene_file, tmp_path):
    out = tmp_path / "dataset"
    # A shell's background jobs, and all that they start, ignore Ctrl-C.
    heeding = (
        "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_DFL); os.execv(sys.argv[1], sys.argv[1:])"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", heeding, *command(scene_file, out, "--frames", "200")],
        cwd=CHECKOUT,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    while process.poll() is None and len(list((out / "frames").glob("*.pose.txt"))) < 2:
        time.sleep(0.01)
    children = psutil.Process(process.pid).children()
    process.send_signal(signal.SIGINT)
    _, complaint = process.communicate(timeout=20)
    assert process.returncode == 130
    assert b"the same command goes on there" in complaint
    assert b"Traceback" not in complaint
    assert not psutil.wait_procs(children, timeout=5)[1]
    assert not list(out.rglob(".unfinished-*"))
    assert open_every_complete_frame(out) >= 2


@pytest.mark.parametrize(
    ("options", "difference"),
    [
        (("--frames", "13"), "its render.frames is 12, now asked for is 13"),
        (("--size", "32x24"), r"its render.size\[0\] is 256, now asked for is 32"),
        (("--samples", "3"), "its render.samples is 2, now asked for is 3"),
        (("--seed", "9"), "its render.seed is 0, now asked for is 9"),
    ],
)
def test_another_recipe_in_the_same_folder_is_refused_by_its_first_difference(
    scene_file, uninterrupted, options, difference
):
    before = contents(uninterrupted)
    done = run(command(scene_file, uninterrupted, *options))
    assert done.returncode == 2
    assert "datagen: error:" in done.stderr
    assert re.search(difference, done.stderr)
    assert contents(uninterrupted) == before


def test_a_folder_with_other_files_is_refused_and_left_alone(make_scene, tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match=r"no dataset of ours.*thesis.txt"):
        render_dataset(make_scene(), tmp_path)
    assert contents(tmp_path) == {"thesis.txt": b"years of work"}
    with pytest.raises(InputError, match="a file, not a folder"):
        render_dataset(make_scene(), tmp_path / "thesis.txt")


@pytest.fixture
def worker_with(tmp_path, monkeypatch):
    """Put some code before the real worker's own."""

    def use(code):
        (tmp_path / "spoilt_worker.py").write_text(
            f"import sys\nfrom datagen.blender import worker\n{code}\nsys.exit(worker.main())\n"
        )
        monkeypatch.setattr(render_workers, "WORKER_MODULE", "spoilt_worker")
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), str(CHECKOUT)]))

    return use


CRASH_AT_1 = """
import os
real = worker._perform
def perform(session, task):
    if task["frame"] == 1:
        print("the last words", file=sys.stderr, flush=True)
        {end}
    return real(session, task)
worker._perform = perform
"""


@pytest.mark.parametrize(
    ("end", "reason"), [("os.abort()", "signal 6"), ("raise RuntimeError('out of luck')", "RuntimeError: out of luck")]
)
def test_a_worker_that_dies_is_reported_with_its_frame_and_last_words_and_the_rest_is_kept(
    make_scene, tmp_path, worker_with, end, reason
):
    worker_with(CRASH_AT_1.format(end=end))
    out = tmp_path / "dataset"
    with pytest.raises(WorkerError, match=f"(?s)frame 1: .*{reason}.*the last words"):
        render_dataset(make_scene(), out)
    assert open_every_complete_frame(out) == 1
    assert not list(out.rglob(".unfinished-*"))


@pytest.mark.parametrize(
    ("missing", "advice"),
    [
        ("sys.modules['bpy'] = None", r'pip install "scanback\[blender\]"'),
        ("sys.modules['OpenEXR'] = None", r'OpenEXR.*pip install "scanback\[blender\]"'),
    ],
)
def test_missing_modules_are_said_with_the_remedy(make_scene, tmp_path, worker_with, missing, advice):
    worker_with(missing)
    with pytest.raises(InputError, match=advice):
        render_dataset(make_scene(), tmp_path / "dataset")
    assert not (tmp_path / "dataset").exists()


def test_a_missing_system_library_is_said_with_the_remedy(make_scene, tmp_path, worker_with):
    worker_with(
        "class Finder:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'bpy': raise ImportError('libXi.so.6: cannot open shared object file')\n"
        "sys.meta_path.insert(0, Finder())"
    )
    with pytest.raises(InputError, match=r"libXi.so.6.*apt-get install .*libxi6"):
        render_dataset(make_scene(), tmp_path / "dataset")


def test_depth_beyond_the_scale_is_refused_with_the_scale_that_fits(make_scene, tmp_path):
    scene = make_scene(render={"frames": 1, "size": [16, 12], "samples": 1, "depth_scale": 1e-5})
    with pytest.raises(InputError, match=r"frame-000000.depth.png: .*set depth_scale to"):
        render_dataset(scene, tmp_path / "dataset")


def test_progress_counts_the_frames_that_are_missing(make_scene, tmp_path):
    steps = []

    def progress(stage, total):
        steps.append((stage, total))
        return lambda: steps.append("one")

    render_dataset(make_scene(), tmp_path / "dataset", progress=progress)
    (tmp_path / "dataset" / "frames" / "frame-000001.pose.txt").unlink()
    render_dataset(make_scene(), tmp_path / "dataset", progress=progress)
    assert steps == [("Rendering", 3), "one", "one", "one", ("Rendering", 1), "one"]
    assert np.isfinite(open_dataset(tmp_path / "dataset").world_from_camera(1)).all()
