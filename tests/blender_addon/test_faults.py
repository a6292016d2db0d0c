"""Full disks and missing rights: told in plain words, nothing is torn by them, and all can be gone on with."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy  # noqa: F401 - the sessions below need it, and its absence should be told here
import pytest

import blender_addon

SESSION = Path(__file__).with_name("faults_session.py")
FULL, READ_ONLY = "No space left on device", "Read-only file system"
UNSHARE = ["unshare", "--map-root-user", "--mount"]


def _run(prefix: list[str], *arguments: str) -> dict[str, Any]:
    environment = {**os.environ, "PYTHONPATH": str(Path(blender_addon.__file__).parents[1])}
    done = subprocess.run(
        [*prefix, sys.executable, str(SESSION), *arguments],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout.partition("SEEN ")[2].partition("\n")[0])


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What was said on full and on read-only disks, which are mounted for one process and those that it starts."""
    probe = [*UNSHARE, "mount", "-t", "tmpfs", "none", "/mnt"]
    if shutil.which("unshare") is None or subprocess.run(probe, capture_output=True, check=False).returncode:
        pytest.skip("no disk can be mounted here: that takes Linux, and leave to make namespaces")
    folder, cache = tmp_path_factory.mktemp("disk"), tmp_path_factory.mktemp("cache")
    return _run(UNSHARE, "disks", str(folder), str(cache))


@pytest.mark.slow
def test_without_any_room_a_scan_is_refused_and_leaves_nothing(seen: dict[str, Any]) -> None:
    told = seen["full"]["no room"]
    assert "disk0" in told
    assert "cannot be written" in told or FULL in told
    assert "choose another folder" in told
    assert "Traceback" not in told
    assert seen["full"]["left of no room"] == []


@pytest.mark.slow
def test_a_disk_that_fills_up_ends_a_scan_that_is_gone_on_with(seen: dict[str, Any]) -> None:
    filled = seen["full"]["filled"]
    assert filled["state"] == "failed"
    assert FULL in filled["message"]
    assert "frames/frame-0000" in filled["message"]
    assert "free space" in filled["message"]
    assert 3 <= filled["whole"] < 12
    assert filled["torn"] == []
    assert filled["unfinished"] == []
    assert filled["why not"] is None
    assert filled["dismissed"] == ["FINISHED"]
    assert seen["full"]["went on"] == ["FINISHED"]
    assert seen["full"]["frames"] == 12
    assert seen["full"]["anew"] == []


@pytest.mark.slow
def test_fusing_on_a_full_disk_leaves_no_half_of_a_reconstruction(seen: dict[str, Any]) -> None:
    told = seen["full"]["fuse"]
    assert FULL in told
    assert "disk0/reconstruction" in told
    assert "free space" in told
    assert seen["full"]["left of fuse"] == []


@pytest.mark.slow
def test_where_nothing_may_be_written_nothing_is_lost(seen: dict[str, Any]) -> None:
    there = seen["read-only"]
    for told in (there["again"], there["elsewhere"]):
        assert READ_ONLY in told
        assert "choose another folder" in told
    assert "disk0" in there["fuse"]
    assert "cannot be written" in there["fuse"]
    assert there["frames"] == 12
    assert there["why not"] is None


@pytest.mark.slow
def test_a_full_cache_is_named_with_its_remedy(seen: dict[str, Any]) -> None:
    told = seen["cache"]["estimate"]
    assert "cache0" in told
    assert "choose another cache folder in preferences" in told
    assert seen["cache"]["left"] == []
    assert seen["cache"]["why not"] is None


@pytest.fixture
def closed() -> Iterator[Path]:
    """A folder that another user may not enter, in one that anybody may."""
    if os.name == "nt":
        pytest.skip("Windows has other rights")
    outer = Path(tempfile.mkdtemp())
    outer.chmod(0o755)
    folder = outer / "closed"
    folder.mkdir(mode=0o700)
    yield folder
    shutil.rmtree(outer)


def test_a_folder_that_may_not_be_entered_is_told_by_every_step(closed: Path) -> None:
    cache = closed.parent / "cache"
    cache.mkdir()
    seen = _run([], "denied", str(closed), str(cache))
    for case, told in seen.items():
        if case.startswith("why"):
            assert told[0] is None, case  # nobody knows before it is tried
            assert all(isinstance(reason, str) for reason in told[1:]), case
        else:
            assert str(closed) in told, case
            assert "Traceback" not in told, (case, told)
            assert ";" in told, (case, told)  # what is wrong; what helps
