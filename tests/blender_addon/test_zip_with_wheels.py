"""The zip that users install, with its wheels: ``make test-extension``.

SCANBACK_BLENDER_PYTHONS may name interpreters beside this one, of other Blender modules, separated as in PATH.
"""

import json
import os
import subprocess
import venv
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy
import pytest

from blender_addon.packaging.build_zips import build_zips
from blender_addon.packaging.targets import PYTHONS, this_platform
from blender_addon.packaging.wheel_files import CHECKOUT

OTHER_PYTHONS = list(filter(None, os.environ.get("SCANBACK_BLENDER_PYTHONS", "").split(os.pathsep)))
MODULES = [
    *(
        "annotated_types",
        "cv2",
        "datagen",
        "fast_simplification",
        "fusion",
        "jinja2",
        "markupsafe",
        "OpenEXR",
        "psutil",
    ),
    *("pydantic", "pydantic_core", "rich", "scipy.spatial.transform", "trimesh", "warp"),
]

INSTALL = """
import importlib, json, os, sys, time
import bpy
archive, modules = sys.argv[1], sys.argv[2:]
bpy.ops.wm.read_factory_settings(use_empty=True)
start = time.perf_counter()
bpy.ops.extensions.package_install_files(filepath=archive, repo="user_default", enable_on_install=True)
seconds = time.perf_counter() - start
(site,) = [path for path in sys.path if os.path.join("extensions", ".local") in path]
files = {name: importlib.import_module(name).__file__ for name in modules}
import numpy
seen = {"site": site, "files": files, "seconds": seconds, "blender": bpy.app.version_string}
seen |= {"numpy": [numpy.__version__, numpy.__file__], "interpreter": sys.executable}
seen["enabled"] = "bl_ext.user_default.scanback" in bpy.context.preferences.addons
print("SEEN " + json.dumps(seen))
"""
UNINSTALL = """
import os
import bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
repositories = [repository.module for repository in bpy.context.preferences.extensions.repos]
bpy.ops.extensions.package_uninstall(repo_index=repositories.index("user_default"), pkg_id="scanback")
"""
IMPORT = "import importlib, sys; print([importlib.import_module(name).__file__ for name in sys.argv[1:]])"

pytestmark = pytest.mark.skipif(
    not os.environ.get("SCANBACK_TEST_WHEELS"), reason="the wheels are a download of 300 MB: make test-extension"
)


@pytest.fixture(scope="module")
def archive() -> Path:
    platform = this_platform()
    if platform is None:
        pytest.skip("there is no zip for this platform")
    (built,) = build_zips(CHECKOUT / "build" / "test-extension", CHECKOUT / "build" / "extension", platforms=[platform])
    return built


def test_the_zip_brings_wheels_for_every_python_and_no_numpy(archive: Path) -> None:
    with zipfile.ZipFile(archive) as content:
        names = [Path(name).name for name in content.namelist() if name.startswith("wheels/") and name.endswith(".whl")]
    for python in PYTHONS:
        tag = "cp" + python.python.replace(".", "")
        assert any(name.startswith("scipy-") and f"-{tag}-{tag}-" in name for name in names)
    assert not [name for name in names if name.startswith("numpy-")]
    assert not [name for name in names if "win" in name.rsplit("-", 1)[1] or "macosx" in name]


@pytest.fixture(scope="module", params=["", *OTHER_PYTHONS])
def python(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    """An interpreter that finds no more than Blender's does: with this one's bpy and NumPy, or one that was named."""
    if request.param:
        return request.param
    folder = tmp_path_factory.mktemp("lean")
    venv.create(folder, symlinks=True)
    (packages,) = folder.glob("lib/python*/site-packages")
    ours = Path(numpy.__file__).parents[1]
    for part in (*ours.glob("numpy*"), *ours.glob("bpy*")):
        (packages / part.name).symlink_to(part)
    return str(folder / "bin" / "python")


def test_the_wheels_load_in_blender_and_beside_it(
    python: str, archive: Path, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    user = tmp_path / "user"
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(user)}
    environment.pop("PYTHONPATH", None)
    seen = json.loads(_run(python, INSTALL, str(archive), *MODULES, env=environment).partition("SEEN ")[2])
    for name in ("blender", "numpy", "seconds"):
        record_property(name, seen[name])
    assert seen["enabled"]
    elsewhere = {name: file for name, file in seen["files"].items() if not file.startswith(seen["site"])}
    assert not elsewhere
    assert not seen["numpy"][1].startswith(seen["site"])

    # The process that a job runs in: Blender's interpreter, told where the wheels lie.
    beside = {**environment, "PYTHONPATH": seen["site"]}
    files = _run(seen["interpreter"], IMPORT, *MODULES, env=beside)
    assert files.count(seen["site"]) == len(MODULES)
    helps = _run(seen["interpreter"], "from fusion.cli import main; main(['--help'])", env=beside)
    assert "reconstruct" in helps

    _run(python, UNINSTALL, env=environment)
    left = [path for path in user.rglob("*") if path.is_file() and path.suffix in {".so", ".py", ".whl"}]
    assert not left


def _run(python: str, code: str, *arguments: str, env: dict[str, str]) -> str:
    command = [python, "-c", code, *arguments]
    done = subprocess.run(command, cwd="/", env=env, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
