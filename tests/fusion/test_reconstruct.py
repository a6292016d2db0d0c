import json

import numpy as np
import pytest
import trimesh
from synthetic_scene import SphereScene, icosphere, write_dataset

from datagen.errors import InputError
from datagen.open_dataset import open_dataset
from fusion.pose.locate import locate
from fusion.reconstruct import reconstruct
from fusion.reconstruction_config import ReconstructionConfig
from fusion.reconstruction_files import read_record
from fusion.volume import memory_budget

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
    seconds = record["seconds"]
    stages = ("waiting", "allocate", "integrate", "mesh", "evaluate", "write")
    assert set(seconds) == {"decode", "total", *stages}
    assert seconds["decode"] > 0
    # Stages follow each other, decoding runs beside them.
    assert 0.5 * seconds["total"] < sum(seconds[stage] for stage in stages) <= seconds["total"]
    fusing = seconds["allocate"] + seconds["integrate"]
    assert record["frames_per_second"] == pytest.approx(20 / fusing)
    assert record["frames_per_second_with_decoding"] == pytest.approx(20 / (fusing + seconds["waiting"]))
    assert 0 < record["voxels_observed"] < 512 * record["blocks"]
    assert record["voxels_observed"] < record["voxel_updates"] < 20 * 512 * record["blocks"]
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
    poses = locate(tmp_path, dataset, device=device.alias).poses
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
    monkeypatch.setattr(memory_budget, "free_memory", lambda _: 40_000_000)
    with pytest.raises(InputError, match=r"would need more than .* GiB .* fits") as error:
        reconstruct(dataset, tmp_path / "out", config(device, voxel_size=voxel_size, frames="::4"))
    assert not (tmp_path / "out").exists()
    fitting = float(str(error.value).split("; ")[1].split(" fits")[0])
    assert voxel_size < fitting < 0.05
    reconstruct(dataset, tmp_path / "out", config(device, voxel_size=fitting, frames="::4"))


def test_one_frame_with_far_depths_is_named_where_the_volume_does_not_fit(device, tmp_path, monkeypatch):
    frames = SCENE.frames_around(8)
    frames[5].depth[:] = 60.0
    folder = write_dataset(tmp_path / "data", frames, depth_scale=0.001)
    data = open_dataset(folder)
    monkeypatch.setattr(memory_budget, "free_memory", lambda _: 200_000_000)
    with pytest.raises(InputError, match=r"frame 5, whose depth reaches 60 m, alone asks for at least .* GiB") as error:
        reconstruct(data, tmp_path / "out", config(device, voxel_size=0.02))
    assert "leave far depths out with --depth-max" in str(error.value)
    assert not (tmp_path / "out").exists()
    reconstruct(data, tmp_path / "out", config(device, voxel_size=0.02, depth_max=50.0))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"voxel_size": -0.01}, r"--voxel-size -0\.01: expected a positive"),
        ({"voxel_size": float("nan")}, r"--voxel-size nan"),
        ({"truncation": 0.0}, r"--truncation 0: expected a positive"),
        ({"voxel_size": 1e-200}, r"--voxel-size 1e-200: .* from 1e-06"),
        ({"depth_max": float("inf")}, r"--depth-max inf"),
    ],
)
def test_lengths_that_make_no_volume_are_refused(device, options, message):
    with pytest.raises(InputError, match=message):
        config(device, **options)


@pytest.mark.parametrize("truncation", [0.005, 5.0])
def test_a_truncation_of_less_than_a_voxel_or_far_too_many_is_refused(device, dataset, tmp_path, truncation):
    with pytest.raises(InputError, match=rf"--truncation {truncation:g}: expected 1 to 64 voxels of 0\.01 m"):
        reconstruct(dataset, tmp_path / "out", config(device, truncation=truncation))
    assert not (tmp_path / "out").exists()


def test_a_truncation_that_was_asked_for_stays_in_the_size_that_fits(device, dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(memory_budget, "free_memory", lambda _: 40_000_000)
    options = {"frames": "::4", "truncation": 0.1}
    with pytest.raises(InputError, match="fits") as error:
        reconstruct(dataset, tmp_path / "out", config(device, voxel_size=0.002, **options))
    fitting = float(str(error.value).split("; ")[1].split(" fits")[0])
    reconstruct(dataset, tmp_path / "out", config(device, voxel_size=fitting, **options))


def test_what_lies_beyond_depth_max_is_not_missed_in_the_metrics(device, tmp_path):
    scene = SphereScene(wall_z=-0.6)
    folder = write_dataset(tmp_path / "data", scene.frames_around(20), ground_truth_mesh="truth.ply")
    vertices, triangles = icosphere(scene)
    wall = trimesh.creation.box(
        extents=(4, 4, 1e-6), transform=trimesh.transformations.translation_matrix((0, 0, -0.6))
    )
    trimesh.util.concatenate([trimesh.Trimesh(vertices, triangles), wall]).export(folder / "truth.ply")
    record = reconstruct(open_dataset(folder), tmp_path / "out", config(device, voxel_size=0.02, depth_max=1.0)).record
    assert record.metrics["completeness_voxels"] < 0.5


@pytest.mark.parametrize("out", ["file", "file/below"])
def test_an_output_that_is_no_folder_is_refused_before_the_work(device, dataset, tmp_path, out):
    (tmp_path / "file").write_text("years of work")
    with pytest.raises(InputError, match="file is a file, not a folder"):
        reconstruct(dataset, tmp_path / out, config(device))
    assert (tmp_path / "file").read_text() == "years of work"


def test_a_broken_ground_truth_is_refused_before_the_work(device, tmp_path):
    folder = write_dataset(tmp_path / "data", SCENE.frames_around(3), ground_truth_mesh="truth.ply")
    with pytest.raises(InputError, match=r"truth\.ply: no such file"):
        reconstruct(open_dataset(folder), tmp_path / "out", config(device))
    assert not (tmp_path / "out").exists()


def test_a_camera_too_far_out_for_single_precision_is_refused(device, tmp_path):
    frames = SphereScene(centre=(500_000, 0, 0)).frames_around(3)
    data = open_dataset(write_dataset(tmp_path / "data", frames))
    with pytest.raises(InputError, match=r"frame 0: the camera stands 5e\+05 m from the world's origin"):
        reconstruct(data, tmp_path / "out", config(device))


def test_a_query_needs_no_pose(device, dataset, tmp_path):
    reconstruct(dataset, tmp_path / "out", config(device, frames="::2"))
    known = locate(tmp_path / "out", dataset, frames="1:8:2", device=device.alias).poses
    queries = open_dataset(write_dataset(tmp_path / "queries", SCENE.frames_around(40)))
    for path in queries.folder.glob("frames/*.pose.txt"):
        path.unlink()
    found = locate(tmp_path / "out", queries, frames="1:8:2", device=device.alias).poses
    assert [pose.nearest for pose in found] == [pose.nearest for pose in known]
    written = json.loads((tmp_path / "out" / "poses.json").read_text())
    assert not any("rotation_error_deg" in entry for entry in written)


def test_a_query_without_depth_is_passed_over_with_its_reason(device, dataset, tmp_path):
    reconstruct(dataset, tmp_path / "out", config(device, frames="::2"))
    frames = SCENE.frames_around(3)
    frames[1].depth[:] = 0
    queries = open_dataset(write_dataset(tmp_path / "queries", frames))
    located = locate(tmp_path / "out", queries, device=device.alias)
    assert [pose.query for pose in located.poses] == [0, 2]
    assert located.failures.keys() == {1}
    assert "no pixel has a valid depth" in located.failures[1]


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
