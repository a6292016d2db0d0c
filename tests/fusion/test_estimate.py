import json
from pathlib import Path

import numpy as np
import pytest
from synthetic_scene import SphereScene, write_dataset

from datagen.open_dataset import open_dataset
from fusion.cli import main
from fusion.estimate import Estimate, estimate
from fusion.reconstruct import reconstruct
from fusion.reconstruction_config import ReconstructionConfig


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("sphere") / "dataset", SphereScene().frames_around(24))


def test_the_area_is_that_of_the_sphere(sphere: Path) -> None:
    """Of a sphere, |nx| + |ny| + |nz| has a mean of exactly 3/2."""
    found = estimate(open_dataset(sphere))
    assert found.taxicab_area == pytest.approx(1.5 * 4 * np.pi * SphereScene().radius ** 2, rel=0.1)
    assert found.frames == 24


def test_what_is_estimated_is_what_comes_out(sphere: Path, tmp_path: Path) -> None:
    dataset = open_dataset(sphere)
    record = reconstruct(dataset, tmp_path / "out", ReconstructionConfig(voxel_size=0.01, device="cpu")).record
    found = estimate(dataset)
    assert found.triangles(0.01) == pytest.approx(record.triangles, rel=0.15)
    assert found.volume_bytes(0.01, 0.04) == pytest.approx(record.blocks * 512 * 8, rel=0.25)


def test_sizes_follow_the_voxels() -> None:
    flat = Estimate(taxicab_area=1.0, voxel_size=0.01, frames=1)
    assert flat.triangles(0.01) == 20_000
    assert flat.triangles(0.005) == 4 * flat.triangles(0.01)
    assert flat.volume_bytes(0.005, 0.02) == pytest.approx(4 * flat.volume_bytes(0.01, 0.04))


def test_the_command_tells_programs(sphere: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["estimate", str(sphere), "--frames", "::3", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["frames"] == 8
    assert answer["triangles"] > 0
    assert answer["devices"][0] == "cpu"
