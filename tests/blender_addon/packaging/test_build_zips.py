import tomllib
from pathlib import Path

import pytest

from blender_addon.packaging.build_zips import MANIFEST, declare_wheels, stage_extension
from datagen.errors import InputError

WHEELS = ["a-1.0-py3-none-any.whl", "b-2.0-cp311-cp311-win_amd64.whl"]


def test_wheels_and_platforms_are_declared_beside_what_the_manifest_says(tmp_path: Path) -> None:
    stage_extension(tmp_path / "stage")
    manifest = tmp_path / "stage" / MANIFEST
    before = tomllib.loads(manifest.read_text())
    declare_wheels(manifest, ["linux-x64", "windows-x64"], WHEELS)
    after = tomllib.loads(manifest.read_text())
    assert after.pop("platforms") == ["linux-x64", "windows-x64"]
    assert after.pop("wheels") == [f"./wheels/{name}" for name in WHEELS]
    assert after == before


def test_a_manifest_that_names_wheels_already_is_refused(tmp_path: Path) -> None:
    manifest = tmp_path / MANIFEST
    manifest.write_text('id = "x"\nwheels = []\n')
    with pytest.raises(InputError, match="names platforms or wheels; remove them"):
        declare_wheels(manifest, [], WHEELS)
