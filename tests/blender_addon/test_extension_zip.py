"""The extension as users get it: built, validated, installed and enabled by Blender's own tools.

The zip here holds the code alone; ``make test-extension`` does the same with the wheels.
"""

import ast
import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import bpy  # noqa: F401 - the session below needs it, and its absence should be told here
import pytest

from blender_addon.packaging.build_zips import EXTENSION, blender_ext, build_zips

SESSION = Path(__file__).with_name("extension_session.py")
BLENDERS_OWN = {"blf", "bpy", "bpy_extras", "gpu", "gpu_extras", "mathutils", "numpy"}
ONLY_IN_A_CHECKOUT = {"__main__.py", "headless", "packaging"}


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("extension")
    (built,) = build_zips(folder, folder / "work", with_wheels=False)
    return built


def test_the_zip_is_valid(archive: Path) -> None:
    output = blender_ext("validate", str(archive))
    assert "success" in output.lower()
    assert not re.search("warning|error", output, re.IGNORECASE)


def test_the_zip_holds_what_blender_runs_and_nothing_more(archive: Path) -> None:
    with zipfile.ZipFile(archive) as content:
        names = {name for name in content.namelist() if not name.endswith("/")}
    ours = {path.relative_to(EXTENSION) for path in EXTENSION.rglob("*.py")}
    ours = {path.as_posix() for path in ours if path.parts[0] not in ONLY_IN_A_CHECKOUT}
    assert names == ours | {"blender_manifest.toml", "LICENSE"}


def test_the_code_keeps_the_platforms_rules(archive: Path) -> None:
    with zipfile.ZipFile(archive) as content:
        sources = {name: content.read(name).decode() for name in content.namelist() if name.endswith(".py")}
    assert sources
    for name, source in sources.items():
        tree = ast.parse(source)
        assert _imported(tree) <= BLENDERS_OWN | sys.stdlib_module_names, name
        assert "bl_info" not in source, name
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                place = f"{node.value.id}.{node.attr}"
                assert place not in {"sys.path", "sys.modules"}, f"{name}:{node.lineno}"


def test_the_manifest_says_what_the_project_says(archive: Path) -> None:
    with zipfile.ZipFile(archive) as content:
        manifest = tomllib.loads(content.read("blender_manifest.toml").decode())
    project = tomllib.loads((EXTENSION.parent / "pyproject.toml").read_text())["project"]
    assert manifest["version"] == project["version"]
    assert manifest["license"] == [f"SPDX:{project['license']}"]
    assert not {"wheels", "platforms"} & manifest.keys()


def test_the_zip_installs_works_and_leaves_nothing_behind(archive: Path, sphere_scan: Any, tmp_path: Path) -> None:
    seen = run_session(archive, sphere_scan.folder, tmp_path)
    before, installed = seen["before"], seen["installed"]
    assert not before["enabled"]
    assert installed["enabled"]
    assert {"import_reconstruction"} <= set(installed["operators"])
    assert installed["classes"]
    assert installed["draws"]["TOPBAR_MT_file_import"] == before["draws"]["TOPBAR_MT_file_import"] + 1
    assert seen["import"] == ["FINISHED"]
    assert seen["objects"] == ["CAMERA", "CAMERA", "CURVE", "CURVE", "CURVE", "MESH"]
    assert {**seen["enabled again"], "files": []} == {**installed, "files": []}
    assert {**seen["disabled"], "files": []} == {**before, "files": []}
    assert seen["job"] == ["running", True, "cancelled", False]
    assert seen["uninstalled"] == before
    assert seen["collections"] == 2
    assert seen["foreign"] == []
    assert seen["policy"] == {}  # as Blender's preferences would warn of


def run_session(archive: Path, folder: Path, tmp_path: Path) -> dict[str, Any]:
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "user")}
    environment.pop("PYTHONPATH", None)
    command = [sys.executable, str(SESSION), str(archive), str(folder)]
    result = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=60
    )
    assert result.returncode == 0, result.stdout + result.stderr
    said, _, seen = result.stdout.partition("SEEN ")
    said += result.stderr
    assert not re.search("warning|policy|traceback", said.replace(str(tmp_path), ""), re.IGNORECASE), said
    return json.loads(seen.partition("\n")[0])


def _imported(tree: ast.Module) -> set[str]:
    """Return the packages that a module imports from outside the extension."""
    names = [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    names += [str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.level == 0]
    return {name.partition(".")[0] for name in names}
