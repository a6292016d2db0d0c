"""The extension as users get it: built, validated, installed and enabled by Blender's own tools."""

import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import bpy
import pytest

PACKAGE = Path(__file__).parents[2] / "blender_addon"

SESSION = """
import json, sys
import bpy

archive, folder = sys.argv[1:]
module = "bl_ext.user_default.scanback"
bpy.ops.wm.read_factory_settings(use_empty=True)


def registered():
    return hasattr(bpy.types, "SCANBACK_PT_reconstruction")


def entries():
    return len(bpy.types.TOPBAR_MT_file_import.draw._draw_funcs)


def enabled():
    return module in bpy.context.preferences.addons


seen = {"entries": entries()}
bpy.ops.extensions.package_install_files(filepath=archive, repo="user_default", enable_on_install=True)
seen["installed"] = (enabled(), registered(), entries())
seen["import"] = list(bpy.ops.scanback.import_reconstruction(directory=folder))
seen["objects"] = sorted(item.type for item in bpy.data.collections["Scanback sphere"].all_objects)
bpy.ops.preferences.addon_disable(module=module)
seen["disabled"] = (enabled(), registered(), entries())
bpy.ops.preferences.addon_enable(module=module)
seen["enabled again"] = (enabled(), registered(), entries())
bpy.ops.scanback.import_reconstruction(directory=folder)
seen["collections"] = len(bpy.data.collections)
packages = {name.partition(".")[0] for name in sys.modules}
seen["foreign"] = sorted(packages & {"blender_addon", "datagen", "fusion"})
repositories = [repository.module for repository in bpy.context.preferences.extensions.repos]
bpy.ops.extensions.package_uninstall(repo_index=repositories.index("user_default"), pkg_id="scanback")
seen["uninstalled"] = (enabled(), registered(), entries())
print("SEEN " + json.dumps(seen))
"""


def _blender_ext(*arguments: str) -> subprocess.CompletedProcess[str]:
    scripts = Path(bpy.utils.system_resource("SCRIPTS"))
    tool = scripts / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"
    command = [sys.executable, str(tool), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("extension")
    result = _blender_ext("build", f"--source-dir={PACKAGE}", f"--output-dir={folder}")
    assert result.returncode == 0, result.stdout + result.stderr
    (built,) = folder.iterdir()
    return built


def test_the_zip_is_valid(archive: Path) -> None:
    result = _blender_ext("validate", str(archive))
    assert result.returncode == 0, result.stdout + result.stderr
    assert not re.search("warning|error", result.stdout + result.stderr, re.IGNORECASE)


def test_the_zip_holds_what_blender_runs_and_nothing_more(archive: Path) -> None:
    with zipfile.ZipFile(archive) as content:
        names = set(content.namelist())
        sources = {name: content.read(name).decode() for name in names if name.endswith(".py")}
    top_level = {path.name for path in PACKAGE.glob("*.py")} - {"__main__.py"}
    assert {name for name in names if not name.endswith("/")} == top_level | {"blender_manifest.toml"}
    for name, source in sources.items():
        imported = re.findall(r"^\s*(?:from|import) ([\w.]+)", source, re.MULTILINE)
        outside = {module.partition(".")[0] for module in imported if not module.startswith(".")}
        allowed = {"bpy", "mathutils", "numpy"} | sys.stdlib_module_names
        assert outside <= allowed, name


def test_the_zip_installs_works_and_leaves_nothing_behind(archive: Path, sphere_scan: Any, tmp_path: Path) -> None:
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "user")}
    environment.pop("PYTHONPATH", None)
    command = [sys.executable, "-c", SESSION, str(archive), str(sphere_scan.folder)]
    result = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=60
    )
    output = result.stdout + result.stderr
    assert result.returncode == 0, output
    assert not re.search("warning|policy|traceback", output, re.IGNORECASE), output
    seen = json.loads(output.partition("SEEN ")[2].partition("\n")[0])
    entries = seen["entries"]
    assert seen["installed"] == seen["enabled again"] == [True, True, entries + 1]
    assert seen["import"] == ["FINISHED"]
    assert seen["objects"] == ["CAMERA", "CAMERA", "CURVE", "CURVE", "CURVE", "MESH"]
    assert seen["disabled"] == seen["uninstalled"] == [False, False, entries]
    assert seen["collections"] == 2
    assert seen["foreign"] == []
