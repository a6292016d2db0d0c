import json

import numpy as np
import pytest
import trimesh
from synthetic_scene import SphereScene, icosphere, write_dataset

from datagen.dataset import open_dataset
from datagen.errors import InputError
from fusion import volume_memory
from fusion.locate import locate
from fusion.reconstruct import reconstruct
from fusion.reconstruction_config import ReconstructionConfig
from fusion.reconstruction_files import read_record

SCENE = SphereScene()
VOXEL_SIZE = 0.01


@pytest.fixture(scope="module")
def dataset_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sphere")
    write_dataset(folder, SCENE.frames_around(40), ground_truth_mesh="ground_truth/mesh.ply")
    vertices, triangles = icosphere(SCENE)
    (folder / "ground_truth").mkdir()
    trimesh.Trimesh(vertices, triangles).export(folder / "ground_truth" / "mesh.ply")
    return folder


@pytest.fixture
def dataset(dataset_folder):
    return open_dataset(dataset_folder)


def config(device, **options):
    return ReconstructionConfig(device=device.alias, **({"voxel_size": VOXEL_SIZE} | options))


def test_a_sphere_comes_back_closed_and_exact(device, dataset, tmp_path):
    result = reconstruct(dataset, tmp_path, config(device))
    mesh = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert mesh.is_watertight
    radii = np.linalg.norm(mesh.vertices - SCENE.centre, axis=1)
    assert np.abs(radii - SCENE.radius).mean() < 0.1 * VOXEL_SIZE
    assert result.record.metrics["chamfer_voxels"] < 0.1
    assert result.record.metrics["fscore"] > 0.999


def test_vertex_colours_are_those_of_the_surface(device, dataset, tmp_path):
    mesh = reconstruct(dataset, tmp_path, config(device)).mesh
    along = mesh.vertices[:, 0] - SCENE.centre[0]
    # Within the truncation a voxel takes the colour of the pixel before it, seen slantingly from the other half.
    for side, color in ((along, (200, 40, 20)), (-along, (20, 40, 200))):
        assert np.abs(mesh.colors[side > 6 * VOXEL_SIZE].astype(int) - color).max() <= 2


def test_the_record_says_what_scripts_rely_on(device, dataset, tmp_path):
    reconstruct(dataset, tmp_path, config(device, frames="::2"))
    record = json.loads((tmp_path / "reconstruction.json").read_text())
    assert record["frames"] == 20
    assert record["voxel_size_m"] == VOXEL_SIZE
    assert record["truncation_m"] == pytest.approx(4 * VOXEL_SIZE)
    assert set(record["seconds"]) == {"decode", "integrate", "mesh", "total"}
    assert record["frames_per_second"] == pytest.approx(20 / record["seconds"]["integrate"])
    mesh = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert (record["vertices"], record["triangles"]) == (len(mesh.vertices), len(mesh.faces))
    assert {"chamfer_m", "accuracy_m", "completeness_m", "fscore", "normal_consistency"} <= set(record["metrics"])
    assert record["config"]["frames"] == "::2"
    assert {"scanback", "warp-lang", "numpy"} <= set(record["versions"])
    assert record["peak_memory_mb"] > 50
    assert [entry["frame"] for entry in record["trajectory"]] == list(range(0, 40, 2))
    assert (tmp_path / record["dataset"]).resolve() == dataset.folder.resolve()


def test_metrics_are_null_without_a_ground_truth(device, tmp_path):
    bare = open_dataset(write_dataset(tmp_path / "data", SCENE.frames_around(4)))
    reconstruct(bare, tmp_path / "out", config(device, voxel_size=0.02))
    assert json.loads((tmp_path / "out" / "reconstruction.json").read_text())["metrics"] is None


def test_sizes_left_open_come_from_the_data(device, dataset, tmp_path):
    record = reconstruct(dataset, tmp_path, ReconstructionConfig(device=device.alias, frames="::4")).record
    # A pixel is some 0.75 m / 170 wide.
    assert record.voxel_size_m == pytest.approx(2 * 0.75 / 170, rel=0.15)
    assert record.truncation_m == pytest.approx(4 * record.voxel_size_m)


def test_held_out_frames_are_located_at_a_fused_pose(device, dataset, tmp_path):
    reconstruct(dataset, tmp_path, config(device, frames="::2"))
    poses = locate(tmp_path, dataset, device=device.alias)
    written = json.loads((tmp_path / "poses.json").read_text())
    assert [pose["query"] for pose in written] == list(range(1, 40, 2))
    fused = {entry.frame: entry.world_from_camera for entry in read_record(tmp_path).trajectory}
    for pose, entry in zip(poses, written, strict=True):
        assert entry["world_from_camera"] == pose.world_from_camera
        np.testing.assert_allclose(entry["world_from_camera"], fused[entry["nearest"]], atol=1e-12)
        assert {"score", "rotation_error_deg", "translation_error_m"} <= set(entry)


def test_frames_beyond_depth_max_are_left_out(device, tmp_path):
    scene = SphereScene(wall_z=-0.6)
    data = open_dataset(write_dataset(tmp_path / "data", scene.frames_around(6)))
    near = reconstruct(data, tmp_path / "near", config(device, voxel_size=0.02, depth_max=1.0)).mesh
    everything = reconstruct(data, tmp_path / "all", config(device, voxel_size=0.02)).mesh
    assert near.vertices[:, 2].min() > -0.45
    assert everything.vertices[:, 2].min() < -0.55


@pytest.mark.parametrize("voxel_size", [1e-6, 5e-4])
def test_a_volume_that_does_not_fit_is_refused_with_the_size_that_does(
    device, dataset, tmp_path, monkeypatch, voxel_size
):
    monkeypatch.setattr(volume_memory, "free_memory", lambda _: 40_000_000)
    with pytest.raises(InputError, match=r"would need more than .* GiB .* fits") as error:
        reconstruct(dataset, tmp_path / "out", config(device, voxel_size=voxel_size, frames="::4"))
    assert not (tmp_path / "out").exists()
    fitting = float(str(error.value).split("; ")[1].split(" fits")[0])
    assert voxel_size < fitting < 0.05
    reconstruct(dataset, tmp_path / "out", config(device, voxel_size=fitting, frames="::4"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"voxel_size": -0.01}, r"--voxel-size -0\.01: expected a positive"),
        ({"voxel_size": float("nan")}, r"--voxel-size nan"),
        ({"truncation": 0.0}, r"--truncation 0: expected a positive"),
        ({"truncation": 0.005}, r"--truncation 0\.005: less than a voxel"),
        ({"depth_max": float("inf")}, r"--depth-max inf"),
    ],
)
def test_lengths_that_make_no_volume_are_refused(device, options, message):
    with pytest.raises(InputError, match=message):
        config(device, **options)


def test_a_record_is_only_there_when_all_else_is(device, dataset, tmp_path, monkeypatch):
    reconstruct(dataset, tmp_path, config(device, frames="::4"))
    locate(tmp_path, dataset, device=device.alias)

    def full_disk(*_):
        raise InputError("no space left")

    monkeypatch.setattr("fusion.reconstruct.save_volume", full_disk)
    with pytest.raises(InputError):
        reconstruct(dataset, tmp_path, config(device, frames="::2"))
    # The mesh is new and the volume old: nothing that speaks for them together may remain.
    assert not (tmp_path / "reconstruction.json").exists()
    assert not (tmp_path / "poses.json").exists()
