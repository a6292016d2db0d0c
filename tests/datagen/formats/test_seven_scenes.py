from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from converted_datasets import convert, write_source
from oracles import oracle
from synthetic_scene import CAMERA

from datagen.errors import InputError
from datagen.open_dataset import open_dataset

KITCHEN = Path(__file__).parents[4] / "shared" / "data" / "7scenes_redkitchen"


def test_kapture_reads_the_same_poses_and_depth(tmp_path):
    importer, records = oracle("tools.kapture_import_7scenes"), oracle("kapture.io.records")
    vga = replace(CAMERA, width=640, height=480, cx=320.0, cy=240.0, fx=585.0, fy=585.0)
    source = write_source(tmp_path / "source", count=2, camera=vga)
    folder = convert(source, tmp_path / "7scenes", "7scenes")
    importer.import_7scenes(str(folder), str(tmp_path / "kapture"), images_import_method=records.TransferAction.copy)
    read = oracle("kapture.io.csv").kapture_from_dir(str(tmp_path / "kapture"))
    for i in range(2):
        pose = read.trajectories[i, "kinect"].inverse()  # kapture has camera_from_world
        world_from_camera = np.eye(4)
        world_from_camera[:3, :3] = oracle("quaternion").as_rotation_matrix(pose.r)
        world_from_camera[:3, 3] = np.ravel(pose.t)
        np.testing.assert_allclose(world_from_camera, source.world_from_camera(i), atol=1e-9)
        path = oracle("kapture.io.records").get_depth_map_fullpath(
            str(tmp_path / "kapture"), read.records_depth[i, "kinect_depth"]
        )
        depth = records.depth_map_from_file(path, (640, 480))
        np.testing.assert_allclose(depth, source.depth(i), atol=0.0005 + 1e-6)


def test_the_nominal_camera_is_taken_for_the_data_sets_own_images_alone(source, tmp_path):
    folder = convert(source, tmp_path / "out", "7scenes")
    assert open_dataset(folder).camera == source.camera
    (folder / "camera-intrinsics.txt").unlink()
    with pytest.raises(InputError, match=r"images of 160×120 are not from the camera of 7-Scenes \(640×480\)"):
        open_dataset(folder)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", ": found 0 rows, expected a 3×3 intrinsic matrix"),
        ("1 2 3\n4 5 6", ": found 2 rows, expected a 3×3 intrinsic matrix"),
        ("1 2 3\n4 5", ", line 2: found 2 numbers, expected a 3×3 intrinsic matrix"),
        ("100 0 50\n0 100 x\n0 0 1", ", line 2: found 'x', expected a number"),
        ("100 1 50\n0 100 50\n0 0 1", ": expected a 3×3 intrinsic matrix.*found"),
        ("0.01 0 50\n0 100 50\n0 0 1", ": camera: fx 0.01"),
        ("100 0 50\n0 100 50\n0 0 1\0", ": holds zero bytes"),
    ],
)
def test_intrinsics_that_are_none_are_refused_by_file(source, tmp_path, text, complaint):
    folder = convert(source, tmp_path / "out", "7scenes")
    (folder / "camera-intrinsics.txt").write_text(text)
    with pytest.raises(InputError, match=f"camera-intrinsics.txt{complaint}"):
        open_dataset(folder)


@pytest.mark.skipif(not KITCHEN.is_dir(), reason="the frames of 7-Scenes' RedKitchen are not here")
@pytest.mark.parametrize("name", ["tum", "bop", "nerfstudio", "open3d", "colmap", "scanback"])
def test_the_real_kitchen_goes_through_every_format_unchanged(tmp_path, name):
    kitchen = open_dataset(KITCHEN)
    there = open_dataset(convert(kitchen, tmp_path / "there", name, frames="3:200:60"))
    back = open_dataset(convert(there, tmp_path / "back", "7scenes"))
    for i, original in zip(back.frame_ids, kitchen.frame_ids[3:200:60], strict=True):
        np.testing.assert_array_equal(back.depth_steps(i), kitchen.depth_steps(original))
        np.testing.assert_array_equal(back.color(i), kitchen.color(original))
        np.testing.assert_allclose(back.world_from_camera(i), kitchen.world_from_camera(original), atol=1e-12)
    assert back.camera == kitchen.camera
