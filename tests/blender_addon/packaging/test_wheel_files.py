import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from blender_addon.packaging.check_bundle import LEFT_OUT
from blender_addon.packaging.wheel_files import CHECKOUT, Wheel, read_pins
from datagen.errors import InputError


def test_every_requirement_of_the_project_travels_or_is_left_out_on_purpose() -> None:
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    required = {canonicalize_name(Requirement(text).name) for text in project["dependencies"]}
    travelling = read_pins().keys() | {"numpy"}
    assert required <= travelling | LEFT_OUT.keys()
    assert not travelling & LEFT_OUT.keys()


def test_pins_fit_what_the_project_asks_for() -> None:
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    pins = read_pins()
    asked = [*project["dependencies"], *project["optional-dependencies"]["blender"]]
    for requirement in map(Requirement, asked):
        pin = pins.get(canonicalize_name(requirement.name))
        assert pin is None or pin in requirement.specifier, requirement


def test_a_wheels_name_is_canonical() -> None:
    wheel = Wheel(Path("OpenCV_python.headless-4.10.0.84-cp37-abi3-win_amd64.whl"))
    assert (wheel.name, str(wheel.version)) == ("opencv-python-headless", "4.10.0.84")


@pytest.mark.parametrize("line", ["scipy", "scipy>=1.15", "scipy==1.15.*"])
def test_pins_name_one_version(tmp_path: Path, line: str) -> None:
    pins = tmp_path / "pins.txt"
    pins.write_text(f"# comment\n\nnumpy-stl==1.0  # why\n{line}\n")
    with pytest.raises(InputError, match=r"pins\.txt:4: expected name==version"):
        read_pins(pins)
