"""Renders to which something happens: death, disk full, power cut, two at once."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import datagen
from datagen.errors import InputError, WorkerError
from datagen.open_dataset import open_dataset
from datagen.rendering import render_workers, scratch
from datagen.rendering.folder_lock import LOCK_FILE, claiming
from datagen.rendering.merge_shards import merge_shards
from datagen.rendering.render_job import render_dataset
from datagen.rendering.scratch import hold, make_scratch, remove_abandoned_scratch
from datagen.rendering.shards import Shard, parse_shard
from datagen.rendering.verify import verify_dataset
from datagen.scene_spec.lens_settings import LensSettings
from datagen.sensors.add_layers import add_lens_layers

CHECKOUT = Path(datagen.__file__).parents[1]

SETTINGS = {"frames": 4, "size": [32, 24], "samples": 2, "bounces": 1, "layers": ["flow", "masks", "normals"]}


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture
def scene(make_scene):
    return make_scene(render=SETTINGS, camera={"stereo_baseline": 0.05})


@pytest.fixture(scope="module")
def straight(blender, tmp_path_factory):
    """What one uninterrupted run writes, by a list that the first test fills."""
    return tmp_path_factory.mktemp("straight") / "dataset"


@pytest.fixture
def whole(scene, straight):
    """The files of one uninterrupted run."""
    if not straight.exists():
        render_dataset(scene, straight)
    return contents(straight)


@pytest.fixture
def worker_with(tmp_path, monkeypatch):
    """Put some code before the real worker's own."""

    def use(code):
        (tmp_path / "spoilt_worker.py").write_text(
            f"import os, signal, sys\nfrom pathlib import Path\nfrom datagen.blender import worker\n{code}\n"
            "sys.exit(worker.main())\n"
        )
        monkeypatch.setattr(render_workers, "WORKER_MODULE", "spoilt_worker")
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), str(CHECKOUT)]))

    return use


DIE_ONCE = """
real = worker._perform
def perform(session, task):
    mark = Path({mark!r}) / str(task["frame"])
    if task["frame"] in {frames} and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return real(session, task)
worker._perform = perform
"""


def test_a_frame_whose_worker_is_killed_is_tried_again_by_a_fresh_one(scene, whole, tmp_path, worker_with):
    worker_with(DIE_ONCE.format(mark=str(tmp_path), frames=(1, 3)))
    told = []
    render_dataset(scene, tmp_path / "dataset", tell=told.append)
    assert contents(tmp_path / "dataset") == whole
    assert [line.split(":")[0] for line in told] == ["frame 1", "frame 3"]
    assert all("signal 9" in line and "a fresh process tries again" in line for line in told)


def test_a_worker_is_replaced_after_its_frames_and_the_bits_stay_the_same(scene, whole, tmp_path, worker_with):
    worker_with(f"(Path({str(tmp_path)!r}) / f'started-{{os.getpid()}}').touch()")
    render_dataset(scene, tmp_path / "dataset", frames_per_worker=2)
    assert contents(tmp_path / "dataset") == whole
    assert len(list(tmp_path.glob("started-*"))) == 3  # the mesh and four frames, two at a time


def test_a_worker_whose_memory_grows_is_replaced(scene, whole, tmp_path, worker_with, monkeypatch):
    monkeypatch.setattr(render_workers, "MEMORY_GRACE_BYTES", 0)
    monkeypatch.setattr(render_workers, "MEMORY_GROWTH", 1.1)
    worker_with(
        f"(Path({str(tmp_path)!r}) / f'started-{{os.getpid()}}').touch()\n"
        "real, hoard = worker._perform, []\n"
        "def perform(session, task):\n"
        "    hoard.append(b'x' * (1 + 200 * 2**20 * (task['frame'] == 2)))\n"
        "    return real(session, task)\n"
        "worker._perform = perform\n"
    )
    render_dataset(scene, tmp_path / "dataset")
    assert contents(tmp_path / "dataset") == whole
    assert len(list(tmp_path.glob("started-*"))) == 2


def test_shards_in_one_folder_or_in_several_are_the_bytes_of_one_run(scene, whole, tmp_path):
    for number in (2, 1):
        render_dataset(scene, tmp_path / "shared", shard=Shard(number=number, count=2))
        render_dataset(scene, tmp_path / f"apart-{number}", shard=Shard(number=number, count=2))
    assert contents(tmp_path / "shared") == whole
    assert "frames/frame-000002.pose.txt" not in contents(tmp_path / "apart-1")
    merge_shards([tmp_path / "apart-1", tmp_path / "apart-2"], tmp_path / "merged")
    assert contents(tmp_path / "merged") == whole


def test_merging_refuses_what_is_not_the_rest_of_the_same_dataset(scene, make_scene, tmp_path):
    half, other = tmp_path / "half", tmp_path / "other"
    render_dataset(scene, half, shard=Shard(number=1, count=2))
    with pytest.raises(InputError, match=r"2 of 4 frames are whole in none of them, the first is 2"):
        merge_shards([half], tmp_path / "merged")
    render_dataset(make_scene(render=SETTINGS | {"seed": 8}), other, shard=Shard(number=2, count=2))
    with pytest.raises(InputError, match=r"of another recipe: its (camera.stereo_baseline|render.seed) is"):
        merge_shards([half, other], tmp_path / "merged")
    assert not (tmp_path / "merged").exists()


def test_shards_share_all_frames_and_no_frame_twice():
    for frames, count in [(500, 3), (7, 7), (10, 4)]:
        parts = [Shard(number=i + 1, count=count).frames(frames) for i in range(count)]
        assert [frame for part in parts for frame in part] == list(range(frames))
    for text in ("0/2", "3/2", "1", "a/b", "1/0"):
        with pytest.raises(InputError, match="--shard"):
            parse_shard(text)
    with pytest.raises(InputError, match="only 2 frames"):
        parse_shard("1/3").frames(2)


@pytest.mark.parametrize("damage", [b"", b"\0" * 500, "cut", "flipped"])
@pytest.mark.parametrize(
    "name",
    [
        "frames/frame-000001.color.png",
        "frames/frame-000001.pose.txt",
        "flow/frame-000001.flow.flo",
        "right_depth/frame-000001.depth.png",
    ],
)
def test_a_damaged_file_is_found_by_the_next_run(scene, whole, straight, damage, name, monkeypatch):
    path = straight / name
    if damage == "flipped":
        if not name.endswith(".png"):
            pytest.skip("only images have a checksum")
        content = bytearray(whole[name])
        content[len(content) // 2] ^= 1
        damage = bytes(content)
    elif damage == "cut":
        damage = whole[name][: len(whole[name]) // 2]
    from datagen.rendering import render_job

    asked = []
    monkeypatch.setattr(render_job, "Job", lambda **_: asked.append(1) or pytest.skip("unreachable"))
    path.write_bytes(damage)
    told = []
    try:
        tasks = render_job._missing(straight, scene, range(4), told.append)
    finally:
        path.write_bytes(whole[name])
    assert [task.frame for task in tasks] == [1]
    assert len(told) == 1
    assert told[0].startswith(str(path))


def test_damaged_frames_are_rendered_again_to_the_same_bits(scene, whole, straight):
    (straight / "frames" / "frame-000001.depth.png").write_bytes(b"\0" * 100)
    (straight / "masks" / "frame-000003.mask.png").write_bytes(b"")
    told = []
    render_dataset(scene, straight, tell=told.append)
    assert contents(straight) == whole
    assert len(told) == 2


def test_a_full_disk_is_said_and_after_it_has_room_the_rerun_goes_on(scene, whole, tmp_path, worker_with):
    worker_with(
        "import resource\n"
        "real = worker._perform\n"
        "def perform(session, task):\n"
        "    write = real(session, task)\n"
        "    if task['frame'] == 2: resource.setrlimit(resource.RLIMIT_FSIZE, (600, 600))\n"
        "    return write\n"
        "worker._perform = perform\n"
    )
    out = tmp_path / "dataset"
    with pytest.raises(InputError, match=r"cannot be written \(File too large\); check .* free space"):
        render_dataset(scene, out)
    assert open_dataset(out).is_complete(0)
    assert not list(out.rglob(".unfinished-*"))
    assert not (out / LOCK_FILE).exists()
    render_workers.WORKER_MODULE = "datagen.blender.worker"
    render_dataset(scene, out)
    assert contents(out) == whole


def test_two_renders_of_the_same_frames_in_one_folder_are_refused_and_other_frames_are_not(tmp_path):
    folder = tmp_path / "dataset"
    other = (
        "import sys\nfrom pathlib import Path\nfrom datagen.errors import InputError\n"
        "from datagen.rendering.folder_lock import claiming\n"
        "try:\n"
        "    with claiming(Path(sys.argv[1]), range(int(sys.argv[2]), int(sys.argv[3]))) as claim:\n"
        "        with claim.alone() as alone: print('alone' if alone else 'beside', flush=True)\n"
        "        if len(sys.argv) > 4: sys.stdin.read()\n"
        "except InputError as error: print('refused', error)\n"
    )

    def claim_elsewhere(*arguments):
        command = [sys.executable, "-c", other, str(folder), *map(str, arguments)]
        return subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=True).stdout

    with claiming(folder, range(50)):
        assert "refused" in claim_elsewhere(0, 100)
        assert "another process renders into this folder now" in claim_elsewhere(49, 60)
        assert claim_elsewhere(50, 100) == "beside\n"
        assert (folder / LOCK_FILE).exists()
    assert claim_elsewhere(0, 100) == "alone\n"
    assert not folder.exists()  # nothing was ever in it

    folder.mkdir()
    holder = subprocess.Popen(
        [sys.executable, "-c", other, str(folder), "0", "9", "stay"],
        cwd=CHECKOUT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert holder.stdout.readline() == b"alone\n"
    assert "refused" in claim_elsewhere(3, 4)
    holder.kill()
    holder.communicate()
    assert claim_elsewhere(3, 4) == "alone\n"  # a claim dies with its process, though its file stays


def test_a_second_render_into_a_busy_folder_is_refused(scene, straight, whole, tmp_path):
    command = [
        sys.executable,
        "-c",
        "import sys\nfrom pathlib import Path\nfrom datagen.rendering.folder_lock import claiming\n"
        "with claiming(Path(sys.argv[1]), range(4)): print(flush=True); sys.stdin.read()",
        str(tmp_path / "dataset"),
    ]
    holder = subprocess.Popen(command, cwd=CHECKOUT, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    holder.stdout.readline()
    with pytest.raises(InputError, match="another process renders into this folder now"):
        render_dataset(scene, tmp_path / "dataset")
    holder.communicate()
    assert len(render_dataset(scene, straight).frame_ids) == 4  # complete: nothing to claim


def test_scratch_folders_of_the_dead_are_removed_and_those_of_the_living_are_not(tmp_path, monkeypatch):
    monkeypatch.setattr(scratch, "MEMORY_FOLDER", tmp_path)
    dead, alive, young = make_scratch(1), make_scratch(1), make_scratch(1)
    assert {dead.parent, alive.parent, young.parent} == {tmp_path}
    for folder in (dead, alive):
        (folder / "image.exr").write_bytes(b"x")
        os.utime(folder, (time.time() - 3600,) * 2)
    stranger = tmp_path / "somebody-elses"
    stranger.mkdir()
    os.utime(stranger, (0, 0))
    with hold(alive):
        remove_abandoned_scratch(parents=(tmp_path,))
        assert sorted(path.name for path in tmp_path.iterdir()) == sorted([alive.name, young.name, stranger.name])
    remove_abandoned_scratch(parents=(tmp_path,))
    assert not alive.exists()


def test_verify_finds_nothing_wrong_with_what_was_rendered_and_names_what_was_changed(scene, whole, straight, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(straight, copy)
    rng = np.random.default_rng(0)
    good = verify_dataset(copy, frames=2, rng=rng)
    assert good.passed
    assert good.same_maker
    assert len(good.verdicts) == 2
    shutil.copy(copy / "frames" / "frame-000000.depth.png", copy / "frames" / "frame-000001.depth.png")
    (copy / "flow" / "frame-000003.flow.flo").write_bytes(b"")
    bad = verify_dataset(copy, frames=99, rng=rng)
    faults = {verdict.frame: verdict.faults for verdict in bad.verdicts}
    assert faults[0] == faults[2] == ()
    assert "depth.png" in faults[1][0]
    assert "steps" in faults[1][0]
    assert faults[3] == ("frame-000003.flow.flo is damaged",)


def test_a_gpu_that_is_required_and_not_there_is_an_error(scene, tmp_path):
    from datagen.blender.device import GPU_TYPES

    probe = subprocess.run(
        [
            sys.executable,
            "-c",
            "import bpy; p = bpy.context.preferences.addons['cycles'].preferences\n"
            f"print(any(d.type != 'CPU' for t in {[kind.upper() for kind in GPU_TYPES]!r}"
            " if t in {e[0] for e in p.get_device_types(bpy.context)} for d in p.get_devices_for_type(t)))",
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    if "True" in probe.stdout:
        pytest.skip("there is a GPU here")
    with pytest.raises(InputError, match="--require-gpu: this would render on the CPU"):
        render_dataset(scene, tmp_path / "dataset", require_gpu=True)
    assert not (tmp_path / "dataset").exists()


def test_a_frame_that_fails_twice_is_reported(scene, tmp_path, worker_with):
    worker_with(
        "real = worker._perform\n"
        "def perform(session, task):\n"
        "    if task['frame'] == 2: raise RuntimeError('out of luck')\n"
        "    return real(session, task)\n"
        "worker._perform = perform\n"
    )
    told = []
    with pytest.raises(WorkerError, match=r"(?s)frame 2: RuntimeError: out of luck; finished frames are kept"):
        render_dataset(scene, tmp_path / "dataset", tell=told.append)
    assert len(told) == 1
    assert open_dataset(tmp_path / "dataset").is_complete(0)


def test_verify_leaves_aside_what_was_made_of_the_images_afterwards(whole, straight, tmp_path):
    copy = shutil.copytree(straight, tmp_path / "copy")
    assert "distorted_depth" not in open_dataset(copy).layers
    add_lens_layers(open_dataset(copy), LensSettings(k1=-0.1))
    assert "distorted_depth" in open_dataset(copy).layers
    found = verify_dataset(copy, frames=1, rng=np.random.default_rng(0))
    assert [verdict.faults for verdict in found.verdicts] == [()]
