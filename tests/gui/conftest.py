"""Blender with an interface on a virtual display, the extension's zip, and a scan to show."""

import json
import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from blender_addon.packaging.build_zips import build_zips
from blender_addon.packaging.targets import this_platform
from blender_addon.packaging.wheel_files import CHECKOUT

ROOM = Path(__file__).parent
BUILD = CHECKOUT / "build"
DISPLAY_SIZE = "1600x1000"
TIME_LIMIT_S = 1200


@dataclass(frozen=True)
class Desktop:
    """A machine with Blender in it; ``shared`` is its folder /shared."""

    root: Path
    shared: Path

    def run(self, session: str, *arguments: str) -> dict[str, Any]:
        """Run a session of this room in Blender's interface and return what it saw."""
        for name in ("window.py", "stalls.py", session):
            shutil.copy(ROOM / name, self.shared)
        width, _, height = DISPLAY_SIZE.partition("x")
        blender = [
            "blender",
            "--factory-startup",
            "--enable-event-simulate",
            "--window-geometry",
            "0",
            "0",
            width,
            height,
        ]
        blender += ["--python-exit-code", "1", "--python", "/shared/window.py"]
        command = ["unshare", "--mount", "--pid", "--fork", "--kill-child", str(ROOM / "on-display.sh")]
        command += [str(self.root), str(self.shared), DISPLAY_SIZE, *blender, "--", f"/shared/{session}", "/shared"]
        command += arguments
        command = ["timeout", str(TIME_LIMIT_S), *command]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        output = done.stdout + done.stderr
        (self.shared / "output.txt").write_text(output)
        seen_file = self.shared / "seen.json"
        assert seen_file.is_file(), output
        seen = json.loads(seen_file.read_text())
        assert "error" not in seen, seen["error"] + output
        assert seen.get("finished"), output
        assert "Traceback" not in output, output  # Blender goes on where a panel fails to draw
        seen["output"] = output
        return seen


@pytest.fixture(scope="session", autouse=True)
def _wanted() -> None:
    if not os.environ.get("SCANBACK_TEST_GUI"):
        pytest.skip("a Blender with an interface is a download of 600 MB: make test-gui")


@pytest.fixture(scope="session")
def debian(_wanted: None) -> Path:
    """The folder of a Debian with Blender in it, made where it is not there yet."""
    if os.geteuid() != 0:
        pytest.skip("only root can make a Debian of its own")
    for program in ("debootstrap", "unshare", "apt-get"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not there: apt-get install debootstrap util-linux")
    root = BUILD / "debian-blender"
    made = subprocess.run([ROOM / "debian-blender.sh", root], capture_output=True, text=True, check=False)
    if made.returncode:
        pytest.skip(f"Debian's Blender cannot be had: {(made.stdout + made.stderr)[-600:]}")
    return root


@pytest.fixture(scope="session")
def zip_with_wheels(_wanted: None) -> Path:
    platform = this_platform()
    assert platform is not None
    (built,) = build_zips(BUILD / "gui", BUILD / "extension", platforms=[platform])
    return built


@pytest.fixture(scope="module")
def desktop(debian: Path, zip_with_wheels: Path, request: pytest.FixtureRequest) -> Desktop:
    """A desktop for one session; its pictures stay in build/gui for people to look at."""
    shared = BUILD / "gui" / Path(request.node.name).stem
    shutil.rmtree(shared, ignore_errors=True)
    shared.mkdir(parents=True)
    os.link(zip_with_wheels, shared / "scanback.zip")
    return Desktop(debian, shared)
