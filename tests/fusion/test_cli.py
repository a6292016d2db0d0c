import json
import shutil

import numpy as np
import pytest
import trimesh
from synthetic_scene import SphereScene, write_dataset

from fusion.cli import main

SCENE = SphereScene()


@pytest.fixture
def data(tmp_path):
    return write_dataset(tmp_path / "data", SCENE.frames_around(6))


def run(capsys, *arguments):
    code = main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_json_is_all_that_goes_to_standard_output(capsys, data, tmp_path):
    out = tmp_path / "out"
    code, printed, _ = run(capsys, "reconstruct", data, out, "--voxel-size", 0.02, "--frames", "::2", "--json")
    assert code == 0
    assert json.loads(printed) == json.loads((out / "reconstruction.json").read_text())
    code, printed, _ = run(capsys, "locate", out, data, "--json")
    assert code == 0
    assert json.loads(printed) == json.loads((out / "poses.json").read_text())
    by_folder, by_file = (run(capsys, "evaluate", mesh, out / "mesh.ply", "--json") for mesh in (out, out / "mesh.ply"))
    assert by_folder[:2] == by_file[:2]
    assert by_file[0] == 0
    assert json.loads(by_file[1])["chamfer_voxels"] < 1e-3


def test_chosen_sizes_are_printed(capsys, data, tmp_path):
    code, printed, _ = run(capsys, "reconstruct", data, tmp_path / "out")
    assert code == 0
    assert "(from the data)" in printed
    assert "(4 voxels)" in printed


def break_pose(folder, text):
    (folder / "frames" / "frame-000002.pose.txt").write_text(text)


def rotated(scale):
    return "\n".join(f"{scale if i == 0 else 1 if i in (5, 10, 15) else 0}" for i in range(16))


def test_a_pose_that_is_rigid_within_rounding_is_mended(capsys, data, tmp_path):
    path = data / "frames" / "frame-000002.pose.txt"
    pose = np.loadtxt(path)
    pose[:3, :3] *= 1 + 4e-4
    np.savetxt(path, pose)
    assert run(capsys, "reconstruct", data, tmp_path / "out", "--voxel-size", 0.02)[0] == 0


def truncate(path):
    path.write_bytes(path.read_bytes()[:-100])


def shrink_camera(folder):
    metadata = json.loads((folder / "dataset.json").read_text())
    metadata["intrinsics"]["width"] = 80
    (folder / "dataset.json").write_text(json.dumps(metadata))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda d: (d / "frames" / "frame-000002.pose.txt").unlink(), "frame-000002.pose.txt: the file is missing"),
        (lambda d: break_pose(d, rotated(1.01)), "frame-000002.pose.txt: the pose is not rigid"),
        (lambda d: break_pose(d, rotated("nan")), "frame-000002.pose.txt: the pose holds NaN"),
        (lambda d: break_pose(d, rotated("inf")), "frame-000002.pose.txt: the pose holds NaN or infinity"),
        (lambda d: break_pose(d, "1 2 3"), "frame-000002.pose.txt: found 3 numbers, expected 16"),
        (
            lambda d: shutil.copy(d / "frames" / "frame-000001.color.png", d / "frames" / "frame-000002.depth.png"),
            "frame-000002.depth.png: found uint8",
        ),
        (lambda d: truncate(d / "frames" / "frame-000002.depth.png"), "frame-000002.depth.png: damaged or cut short"),
        (lambda d: truncate(d / "frames" / "frame-000002.color.png"), "frame-000002.color.png: damaged or cut short"),
        (shrink_camera, "the image is 160×120, the dataset's camera 80×120"),
        (lambda d: (d / "dataset.json").write_text("{"), "dataset.json: "),
        (lambda d: shutil.rmtree(d / "frames"), "frame-000000.color.png: the file is missing"),
        (lambda d: [shutil.rmtree(d), d.mkdir()], "not a dataset"),
    ],
)
def test_bad_datasets_give_one_clear_error_and_nothing_half_written(capsys, data, tmp_path, spoil, message):
    spoil(data)
    code, printed, errors = run(capsys, "reconstruct", data, tmp_path / "out", "--voxel-size", 0.02)
    assert code == 2
    assert printed == ""
    assert message in errors.replace("\n", "")
    assert errors.count("fusion: error:") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--voxel-size", "-1"], "--voxel-size -1: expected a positive number"),
        (["--device", "cuda:7"], "--device cuda:7: not on this machine; there is cpu"),
        (["--frames", "9:12"], "--frames 9:12: selects none of the dataset's 6 frames"),
        (["--frames", "a:b"], "--frames a:b: expected START:STOP:STEP"),
        (["--voxel-size", "nan"], "--voxel-size nan: expected a positive number"),
        (["--oracle", "volume"], "--oracle volume: marching cubes asks no oracle; add --mesher dual-contouring"),
        (["--flatness", "0.1"], "--flatness 0.1: marching cubes merges no cells; add --mesher dual-contouring"),
        (["--depth-max", "0.1"], "none of the 6 chosen frames has a valid depth"),
    ],
)
def test_bad_options_give_one_clear_error(capsys, data, tmp_path, arguments, message):
    code, printed, errors = run(capsys, "reconstruct", data, tmp_path / "out", *arguments)
    assert code == 2
    assert printed == ""
    assert message in errors
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--threshold", "nan"], "--threshold nan: expected a positive number"),
        (["--threshold", "inf"], "--threshold inf: expected a positive number"),
        (["--voxel-size", "-1", "--threshold", "0.1"], "--voxel-size -1: expected a positive number"),
        (["--voxel-size", "0", "--threshold", "0.1"], "--voxel-size 0: expected a positive number"),
        ([], "its voxel size is not known; give --voxel-size or --threshold"),
    ],
)
def test_bad_thresholds_give_one_clear_error(capsys, tmp_path, arguments, message):
    trimesh.creation.box().export(tmp_path / "box.ply")
    code, printed, errors = run(capsys, "evaluate", tmp_path / "box.ply", tmp_path / "box.ply", *arguments)
    assert code == 2
    assert printed == ""
    assert message in errors


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        ([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], "a vertex is NaN or infinite"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 7]], "a triangle names a vertex that is not there"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, -1]], "a triangle names a vertex that is not there"),
    ],
)
def test_meshes_that_make_no_sense_are_refused(capsys, tmp_path, vertices, faces, message):
    header = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n" + "".join(
        f"property float {axis}\n" for axis in "xyz"
    )
    body = "\n".join(" ".join(map(str, row)) for row in [*vertices, *([3, *face] for face in faces)])
    path = tmp_path / "mesh.ply"
    path.write_text(f"{header}element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n{body}\n")
    code, _, errors = run(capsys, "evaluate", path, path, "--threshold", "0.1")
    assert code == 2
    assert f"mesh.ply: {message}" in errors


@pytest.mark.parametrize(
    ("key", "value"), [("depth_scale", float("inf")), ("depth_scale", 1e300), ("frame_count", 10**12), ("version", 9)]
)
def test_metadata_out_of_range_is_refused_by_its_key(capsys, data, tmp_path, key, value):
    metadata = json.loads((data / "dataset.json").read_text())
    (data / "dataset.json").write_text(json.dumps(metadata | {key: value}))
    code, _, errors = run(capsys, "reconstruct", data, tmp_path / "out")
    assert code == 2
    assert f"dataset.json: {key}: expected" in errors


def test_a_focal_length_of_no_camera_is_refused(capsys, data, tmp_path):
    metadata = json.loads((data / "dataset.json").read_text())
    metadata["intrinsics"]["fx"] = 1e-300
    (data / "dataset.json").write_text(json.dumps(metadata))
    code, _, errors = run(capsys, "reconstruct", data, tmp_path / "out")
    assert code == 2
    assert "fx 1e-300 for an image of 160×120 pixels" in errors


def test_locating_needs_a_reconstruction(capsys, data, tmp_path):
    code, _, errors = run(capsys, "locate", tmp_path, data)
    assert code == 2
    assert "reconstruction.json: cannot be read" in errors


def test_a_point_cloud_is_no_mesh(capsys, tmp_path):
    path = tmp_path / "points.ply"
    header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header"
    path.write_text(f"{header}\n0 0 0\n")
    code, _, errors = run(capsys, "evaluate", path, path, "--threshold", "0.1")
    assert code == 2
    assert "points.ply: holds no triangles" in errors
