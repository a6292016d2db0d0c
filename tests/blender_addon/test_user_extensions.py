"""Blenders that we start leave the user's own Blender as it is."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from datagen.blender_program import EXTENSIONS_VARIABLE
from datagen.scene_spec.measured_model import measure_model

pytestmark = pytest.mark.slow

MANIFEST = """
schema_version = "1.0.0"
id = "users_own"
version = "1.0.0"
name = "User's own"
tagline = "An extension with a wheel"
maintainer = "somebody"
type = "add-on"
blender_version_min = "4.2.0"
license = ["SPDX:GPL-3.0-or-later"]
wheels = ["./wheels/of_the_user-1.0-py3-none-any.whl"]
"""
INSTALL = """
import sys
import bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.extensions.package_install_files(filepath=sys.argv[1], repo="user_default", enable_on_install=True)
bpy.ops.wm.save_userpref()
"""
RESET = """
import bpy
from datagen.blender_program import leaving_extensions_alone
with leaving_extensions_alone():
    bpy.ops.wm.read_factory_settings(use_empty=True)
"""
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def _write_extension(path: Path) -> None:
    info = "of_the_user-1.0.dist-info"
    files = {
        "of_the_user.py": "",
        f"{info}/METADATA": "Metadata-Version: 2.1\nName: of-the-user\nVersion: 1.0\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    files[f"{info}/RECORD"] = "".join(f"{name},,\n" for name in [*files, f"{info}/RECORD"])
    wheel = path.with_suffix(".whl")
    with zipfile.ZipFile(wheel, "w") as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("blender_manifest.toml", MANIFEST)
        archive.writestr("__init__.py", "def register(): pass\ndef unregister(): pass\n")
        archive.write(wheel, "wheels/of_the_user-1.0-py3-none-any.whl")


def test_the_wheels_of_the_users_extensions_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Blender removes all wheels that no enabled extension asks for when it is reset, which ours are at first."""
    user = tmp_path / "user"
    monkeypatch.setenv("BLENDER_USER_RESOURCES", str(user))
    monkeypatch.delenv(EXTENSIONS_VARIABLE, raising=False)
    _write_extension(tmp_path / "own.zip")
    install = [sys.executable, "-c", INSTALL, str(tmp_path / "own.zip")]
    subprocess.run(install, check=True, capture_output=True, timeout=60)
    before = sorted(user.rglob("*of_the_user*"))
    assert any(path.name == "of_the_user.py" for path in before)
    (tmp_path / "triangle.obj").write_text(TRIANGLE)
    assert measure_model(tmp_path / "triangle.obj").high == pytest.approx((1, 0, 1), abs=1e-6)  # .obj has y up
    assert sorted(user.rglob("*of_the_user*")) == before
    subprocess.run([sys.executable, "-c", RESET], check=True, capture_output=True, timeout=60)
    assert sorted(user.rglob("*of_the_user*")) == before
