"""Folders that Blenders share: dead ones' jobs are swept away, and a scan is one's at a time."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy
import pytest

from blender_addon.errors import ReconstructionError
from blender_addon.jobs.folder_claim import claiming
from blender_addon.jobs.job_folder import JobFolder
from blender_addon.scan_folder import scan_folder, settle_folder
from blender_addon.settings import ScanProperties
from blender_addon.steps.scan import prepare_scan


def _in_another_process(code: str, *arguments: str) -> "subprocess.Popen[str]":
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    while (line := process.stdout.readline()) != "ready\n":  # Blender 5.2 may say before where its colours are from
        assert line, "it ended by itself"
    return process


HOLDS_A_FOLDER = """
import sys
from pathlib import Path
from blender_addon.jobs.job_folder import JobFolder
folder = JobFolder(Path(sys.argv[1]))
print("ready", flush=True)
sys.stdin.read()
"""


def test_folders_of_dead_blenders_are_removed_and_those_of_sleeping_ones_stay(tmp_path: Path) -> None:
    alive, dead = (_in_another_process(HOLDS_A_FOLDER, str(tmp_path)) for _ in range(2))
    try:
        (first, second) = sorted(tmp_path.iterdir(), key=lambda path: path.stat().st_mtime_ns)
        dead.kill()
        dead.wait()
        for folder in (first, second):
            os.utime(folder, (0, 0))  # nothing has happened there for long
        own = JobFolder(tmp_path)
        assert sorted(tmp_path.iterdir()) == sorted([first, own.path])
        own.remove()
        assert list(tmp_path.iterdir()) == [first]
    finally:
        for process in (alive, dead):
            process.kill()
            process.communicate()


HOLDS_A_CLAIM = """
import sys
from pathlib import Path
from blender_addon.jobs.folder_claim import claiming
with claiming(Path(sys.argv[1])):
    print("ready", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def busy(sphere_scan: Any) -> Iterator["subprocess.Popen[str]"]:
    """Another Blender, at work in the folder that the sphere's reconstruction lies in."""
    process = _in_another_process(HOLDS_A_CLAIM, str(sphere_scan.folder.parent))
    yield process
    process.kill()
    process.communicate()


@pytest.mark.usefixtures("extension")
def test_where_another_blender_is_at_work_nothing_is_begun(
    sphere_scan: Any, tmp_path: Path, busy: "subprocess.Popen[str]"
) -> None:
    """And when that one dies, however hard, the folder is free."""
    folder = tmp_path  # of the scan: the reconstruction and the dataset lie in it
    sphere_scan.folder.rename(folder / "reconstruction")
    bpy.ops.mesh.primitive_cube_add()
    scan, operators = ScanProperties.__annotations__, bpy.ops.scanback
    settings = {name: getattr(bpy.context.scene.scanback.scan, name) for name in scan}
    before = sorted(folder.rglob("*"))
    calls: tuple[Any, ...] = (
        lambda: operators.scan(folder=str(folder), frames=1, width=8, height=8),
        lambda: operators.fuse(folder=str(folder), dataset=str(folder / "reconstruction" / "dataset")),
        lambda: operators.locate(folder=str(folder), query="HELD_OUT"),
        lambda: operators.compare(folder=str(folder), truth="OBJECT", object_name="Cube"),
    )
    for call in calls:
        with pytest.raises(RuntimeError, match=f"{folder}: another Blender is at work in this folder; wait until"):
            call()
    assert sorted(folder.rglob("*")) == before
    busy.send_signal(signal.SIGKILL)
    busy.wait()
    prepare_scan(bpy.context.scene, None, folder, settings, overwrite=False)
    assert {path.name for path in folder.iterdir()} == {"reconstruction", "source"}


def test_a_claim_leaves_nothing_and_is_its_processs_alone(tmp_path: Path) -> None:
    new = tmp_path / "new"
    at_work = pytest.raises(ReconstructionError, match="another Blender is at work")
    with claiming(new, makes=True), at_work, claiming(new):
        pass
    assert not new.exists()
    with claiming(new):  # which is not there: whoever needs it will tell
        assert not new.exists()
    with claiming(new, makes=True):
        (new / "made").touch()
    assert [path.name for path in new.iterdir()] == ["made"]


@pytest.mark.usefixtures("extension")
def test_scenes_of_one_file_have_folders_of_their_own(tmp_path: Path) -> None:
    first = bpy.context.scene
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    assert scan_folder(first) == tmp_path / "shot_scanback"
    assert settle_folder(first) == tmp_path / "shot_scanback"  # something is scanned there
    second, third = bpy.data.scenes.new("Night / rain"), bpy.data.scenes.new("Day")
    folders = [scan_folder(scene) for scene in (first, second, third)]
    assert folders[0] == tmp_path / "shot_scanback"
    assert len(set(folders)) == 3
    assert {folder.parent for folder in folders} == {tmp_path}
    settle_folder(second)
    bpy.data.scenes.remove(third)
    bpy.data.scenes.remove(first)
    assert scan_folder(second) == folders[1]
