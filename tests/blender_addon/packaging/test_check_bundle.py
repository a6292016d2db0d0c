import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from blender_addon.packaging.check_bundle import check_bundle
from blender_addon.packaging.targets import PLATFORMS, BlenderPython
from blender_addon.packaging.wheel_files import Wheel
from datagen.errors import InputError

LINUX, WINDOWS, _ = PLATFORMS
PYTHON = BlenderPython(blender="4.2 to 5.0", python="3.11", numpy=("1.24.3", "1.26.4"))
MakeWheel = Callable[..., Wheel]


@pytest.fixture
def make_wheel(tmp_path: Path) -> MakeWheel:
    def make(name: str, version: str, *requirements: str) -> Wheel:
        path = tmp_path / f"{name}-{version}-py3-none-any.whl"
        lines = ["Metadata-Version: 2.1", f"Name: {name}", f"Version: {version}"]
        lines += [f"Requires-Dist: {requirement}" for requirement in requirements]
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(
                f"{name}-{version}.dist-info/METADATA", "\n".join([*lines, "", "Requires-Dist: no header"])
            )
        return Wheel(path)

    return make


def test_wheels_that_fit_pass(make_wheel: MakeWheel) -> None:
    wheels = [
        make_wheel("ours", "1.0", "Part.One >=2,<3", "numpy>=1.24", "embreex", 'pytest; extra == "dev"'),
        make_wheel("part_one", "2.5", 'colorama; sys_platform == "win32"', 'old; python_version < "3.11"'),
    ]
    check_bundle(wheels, LINUX, PYTHON)


def test_what_a_wheel_requires_must_travel_too(make_wheel: MakeWheel) -> None:
    wheels = [make_wheel("part_one", "2.5", 'colorama; sys_platform == "win32"')]
    check_bundle(wheels, LINUX, PYTHON)
    with pytest.raises(InputError, match=r"part_one-2\.5.* in windows-x64, Python 3\.11: asks for colorama.*is none"):
        check_bundle(wheels, WINDOWS, PYTHON)


def test_a_version_that_a_wheel_refuses_is_named(make_wheel: MakeWheel) -> None:
    wheels = [make_wheel("ours", "1.0", "part-one<2"), make_wheel("part_one", "2.5")]
    with pytest.raises(InputError, match=r"asks for part-one<2, but there is 2\.5"):
        check_bundle(wheels, LINUX, PYTHON)


def test_each_numpy_that_blender_brings_must_be_accepted(make_wheel: MakeWheel) -> None:
    with pytest.raises(InputError, match=r"asks for numpy>=1\.26, but Blender 4\.2 to 5\.0 brings 1\.24\.3;"):
        check_bundle([make_wheel("ours", "1.0", "numpy>=1.26")], LINUX, PYTHON)


def test_numpy_does_not_travel(make_wheel: MakeWheel) -> None:
    with pytest.raises(InputError, match="linux-x64: NumPy must not travel"):
        check_bundle([make_wheel("numpy", "1.26.4")], LINUX, PYTHON)
