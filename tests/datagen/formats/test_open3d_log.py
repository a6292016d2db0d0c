import json

import numpy as np
import pytest
from oracles import oracle

from datagen.errors import InputError
from datagen.open_dataset import open_dataset
from datagen.rigid import transform_points

LOG = "scene/trajectory.log"


@pytest.fixture
def folder(converted):
    return converted("open3d")


def test_open3d_reads_the_same_trajectory_and_camera(source, folder):
    open3d = oracle("open3d")
    trajectory = open3d.io.read_pinhole_camera_trajectory(str(folder / LOG))
    assert len(trajectory.parameters) == 5
    for i, entry in enumerate(trajectory.parameters):
        np.testing.assert_allclose(np.linalg.inv(entry.extrinsic), source.world_from_camera(i), atol=1e-9)
    intrinsic = open3d.io.read_pinhole_camera_intrinsic(str(folder / "camera_intrinsic.json"))
    camera = source.camera
    assert (intrinsic.width, intrinsic.height) == (camera.width, camera.height)
    expected = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    np.testing.assert_array_equal(intrinsic.intrinsic_matrix, expected)


def test_open3d_puts_every_pixel_where_we_do(source, folder):
    """As its reconstruction system reads frames: config.json's scale, the images, the intrinsics, the pose."""
    open3d = oracle("open3d")
    config = json.loads((folder / "config.json").read_text())
    intrinsic = open3d.io.read_pinhole_camera_intrinsic(str(folder / config["path_intrinsic"]))
    trajectory = open3d.io.read_pinhole_camera_trajectory(str(folder / LOG))
    for i in (0, 3):
        image = open3d.geometry.RGBDImage.create_from_color_and_depth(
            open3d.io.read_image(str(folder / f"color/{i:06d}.png")),
            open3d.io.read_image(str(folder / f"depth/{i:06d}.png")),
            depth_scale=config["depth_scale"],
            depth_trunc=config["depth_max"],
            convert_rgb_to_intensity=False,
        )
        cloud = open3d.geometry.PointCloud.create_from_rgbd_image(image, intrinsic, trajectory.parameters[i].extrinsic)
        depth = source.depth(i)
        points = transform_points(source.world_from_camera(i), source.camera.back_project(depth))[depth > 0]
        assert len(points) > 1000
        np.testing.assert_allclose(np.asarray(cloud.points), points, atol=1e-6)
        np.testing.assert_allclose(np.asarray(cloud.colors) * 255, source.color(i)[depth > 0], atol=1e-3)


def test_a_trajectory_that_open3d_wrote_is_read(source, folder):
    open3d = oracle("open3d")
    trajectory = open3d.io.read_pinhole_camera_trajectory(str(folder / LOG))
    (folder / LOG).unlink()
    open3d.io.write_pinhole_camera_trajectory(str(folder / LOG), trajectory)
    opened = open_dataset(folder)
    for i in range(5):
        np.testing.assert_allclose(opened.world_from_camera(i), source.world_from_camera(i), atol=1e-7)


def test_other_names_that_the_reconstruction_system_takes_are_found(source, folder):
    (folder / LOG).rename(folder / "lounge_trajectory.log")
    (folder / "color").rename(folder / "rgb")
    (folder / "config.json").unlink()
    opened = open_dataset(folder)
    np.testing.assert_array_equal(opened.color(4), source.color(4))
    assert opened.depth_scale == 0.001
    assert any("Open3D's default" in note for note in opened.notes)


def test_images_count_by_number_not_by_letter(source, folder):
    for kind in ("color", "depth"):
        for i in (4, 3, 2, 1, 0):
            (folder / kind / f"{i:06d}.png").rename(folder / kind / f"{7 + i}.png")
    opened = open_dataset(folder)
    assert opened.frame_ids == (7, 8, 9, 10, 11)
    np.testing.assert_array_equal(opened.color(10), source.color(3))
    np.testing.assert_allclose(opened.world_from_camera(10), source.world_from_camera(3), atol=1e-12)


@pytest.mark.parametrize(
    ("number", "line", "complaint"),
    [
        (6, "1 1", r"trajectory.log, line 6: found 2 fields, expected the three integers"),
        (8, "1 0 0", r"trajectory.log, line 8: found 3 fields, expected a row of a 4×4"),
        (8, "1 0 zero 0", r"trajectory.log, line 8: found 'zero', expected a number"),
        (8, "5 5 5 5", r"trajectory.log, line 6: the pose is not rigid"),
        (25, "", r"trajectory.log, line 24: the file ends within a pose"),
    ],
)
def test_a_malformed_line_is_named(folder, number, line, complaint):
    lines = (folder / LOG).read_text().splitlines()
    lines[number - 1] = line
    (folder / LOG).write_text("\n".join(lines))
    with pytest.raises(InputError, match=complaint):
        open_dataset(folder)


def test_as_many_poses_as_images_are_expected(folder):
    (folder / "depth" / "000002.png").unlink()
    with pytest.raises(InputError, match=r"depth: holds 4 images, .*trajectory.log 5 poses"):
        open_dataset(folder)


@pytest.mark.parametrize(
    ("name", "content", "complaint"),
    [
        ("camera_intrinsic.json", None, r"camera_intrinsic.json: the file is missing; write Open3D's camera there"),
        ("camera_intrinsic.json", {"width": 160}, r"camera_intrinsic.json: intrinsic_matrix: found None, expected 9"),
        ("camera_intrinsic.json", {"intrinsic_matrix": [1.0] * 9}, r"width, height: found \[None, None\]"),
        ("config.json", {"depth_scale": -1}, r"config.json: depth_scale: found -1"),
        ("config.json", {"depth_scale": "mm"}, r"config.json: depth_scale: found 'mm', expected 1 finite number"),
    ],
)
def test_what_is_wrong_with_the_json_files_is_named(folder, name, content, complaint):
    (folder / name).unlink() if content is None else (folder / name).write_text(json.dumps(content))
    with pytest.raises(InputError, match=complaint):
        open_dataset(folder)


def test_an_intrinsic_matrix_by_rows_is_noticed(folder):
    path = folder / "camera_intrinsic.json"
    content = json.loads(path.read_text())
    content["intrinsic_matrix"] = np.reshape(content["intrinsic_matrix"], (3, 3)).T.ravel().tolist()
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"camera_intrinsic.json: expected a 3×3 intrinsic matrix"):
        open_dataset(folder)


def test_several_logs_are_ambiguous(folder):
    (folder / LOG).rename(folder / "a.log")
    (folder / "b.log").write_text("")
    with pytest.raises(InputError, match=r"holds 2 .log files; name the trajectory scene/trajectory.log"):
        open_dataset(folder)
