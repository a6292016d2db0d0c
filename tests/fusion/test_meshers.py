"""``fusion reconstruct`` with each way of meshing."""

import json

import numpy as np
import pytest
from mesh_topology import is_closed, is_manifold, self_intersections
from synthetic_scene import SphereScene, write_dataset

from datagen.errors import InputError
from datagen.open_dataset import open_dataset
from fusion.cli import main
from fusion.reconstruct import reconstruct
from fusion.reconstruction_config import ReconstructionConfig

SCENE, VOXEL_SIZE = SphereScene(), 0.02


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return open_dataset(write_dataset(tmp_path_factory.mktemp("data"), SCENE.frames_around(40)))


def error(mesh):
    """Return the vertices' mean distance from the sphere, in voxels."""
    return np.abs(np.linalg.norm(mesh.vertices - np.array(SCENE.centre), axis=1) - SCENE.radius).mean() / VOXEL_SIZE


@pytest.mark.parametrize("storage", ["packed", "full"])
def test_dual_contouring_of_the_depth_images_is_nearest_to_the_truth(device, dataset, tmp_path, storage):
    options = {"device": device.alias, "voxel_size": VOXEL_SIZE, "storage": storage}
    ways = {
        "cubes": {"mesher": "marching-cubes"},
        "volume": {"mesher": "dual-contouring", "oracle": "volume"},
        "depth": {"mesher": "dual-contouring"},
    }
    results = {
        name: reconstruct(dataset, tmp_path / name, ReconstructionConfig(**options, **way))
        for name, way in ways.items()
    }
    for name in ("volume", "depth"):
        mesh = results[name].mesh
        assert is_closed(mesh)
        assert is_manifold(mesh)
        assert self_intersections(mesh) == 0
        assert error(mesh) < 0.1
    assert error(results["depth"].mesh) < 0.5 * error(results["cubes"].mesh)
    chamfers = {name: result.record.metrics for name, result in results.items()}
    assert all(metrics is None for metrics in chamfers.values())
    # What was fused is the same whatever meshes it; colours too.
    red = results["depth"].mesh.vertices[:, 0] - SCENE.centre[0] > 6 * VOXEL_SIZE
    assert np.abs(results["depth"].mesh.colors[red].astype(int) - (200, 40, 20)).max() <= 2
    assert results["depth"].record.voxel_updates == results["cubes"].record.voxel_updates


def test_the_record_says_how_the_mesh_was_made(device, dataset, tmp_path, capsys):
    arguments = ["--voxel-size", "0.03", "--device", device.alias, "--mesher", "dual-contouring", "--oracle", "depth"]
    assert main(["reconstruct", str(dataset.folder), str(tmp_path), *arguments, "--json"]) == 0
    record = json.loads((tmp_path / "reconstruction.json").read_text())
    assert (record["config"]["mesher"], record["config"]["oracle"]) == ("dual-contouring", "depth")
    assert json.loads(capsys.readouterr().out) == record
    # The second decoding is part of meshing, not of fusing.
    seconds = record["seconds"]
    fusing = seconds["allocate"] + seconds["integrate"] + seconds["waiting"]
    assert record["frames_per_second_with_decoding"] == pytest.approx(40 / fusing)


@pytest.mark.parametrize(("option", "value"), [("mesher", "dual"), ("oracle", "images")])
def test_a_way_that_there_is_not_is_refused(option, value):
    with pytest.raises(InputError, match=f"--{option} {value}: expected one of"):
        ReconstructionConfig(**{option: value})
