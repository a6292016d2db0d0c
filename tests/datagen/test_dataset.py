import json

import numpy as np
import pytest

from datagen.dataset import read_pose
from datagen.dataset_format import Intrinsics, Metadata, write_metadata
from datagen.dataset_summary import describe, summarise
from datagen.dataset_writer import write_frame, write_pose
from datagen.errors import InputError
from datagen.images import write_color, write_depth
from datagen.layers import LAYERS, layer_file
from datagen.open_dataset import open_dataset
from datagen.rigid import look_at


def pose(frame):
    return look_at([np.cos(frame), np.sin(frame), 0.5], [0, 0, 0])


@pytest.fixture
def folder(tmp_path):
    """A dataset of three frames, 8×6."""
    metadata = Metadata(
        frame_count=3,
        intrinsics=Intrinsics(width=8, height=6, fx=10.0, fy=10.0, cx=3.5, cy=2.5),
        depth_scale=0.0001,
        frames_per_second=30.0,
        recipe={"name": "test"},
        provenance={},
    )
    write_metadata(tmp_path, metadata)
    for frame in range(3):
        write_frame(
            tmp_path / "frames",
            frame,
            color=np.full((6, 8, 3), frame, np.uint8),
            depth=np.full((6, 8), 1.0 + frame),
            world_from_camera=pose(frame),
            depth_scale=0.0001,
        )
    return tmp_path


def test_what_was_written_is_read(folder):
    dataset = open_dataset(folder)
    assert dataset.frame_ids == (0, 1, 2)
    frame = dataset.frame(2)
    np.testing.assert_array_equal(frame.color, np.full((6, 8, 3), 2))
    np.testing.assert_allclose(frame.depth, 3.0, atol=1e-6)
    np.testing.assert_allclose(frame.world_from_camera, pose(2), atol=1e-15)


def test_a_pose_survives_the_disk_bit_for_bit(tmp_path):
    path = tmp_path / "pose.txt"
    matrix = pose(1.234)
    write_pose(path, matrix)
    np.testing.assert_array_equal(np.loadtxt(path), matrix)


def test_a_missing_pose_is_named(folder):
    missing = folder / "frames" / "frame-000001.pose.txt"
    missing.unlink()
    dataset = open_dataset(folder)
    assert not dataset.is_complete(1)
    with pytest.raises(InputError, match=r"frame-000001.pose.txt.*missing"):
        dataset.frame(1)
    with pytest.raises(InputError, match=r"frame-000001.pose.txt.*1 of the 3"):
        dataset.require(dataset.frame_ids)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("1 2 3", "found 3 numbers"),
        ("one", "4×4"),
        ("", "found 0 numbers"),
        ("nan 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "NaN"),
        ("inf 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "infinity"),
        ("2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", "not rigid"),
    ],
)
def test_a_bad_pose_is_refused_by_file(tmp_path, text, complaint):
    path = tmp_path / "frame-000000.pose.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=f"frame-000000.pose.txt.*{complaint}"):
        read_pose(path)


def test_an_image_of_another_size_is_refused(folder):
    write_color(folder / "frames" / "frame-000001.color.png", np.zeros((12, 16, 3), np.uint8))
    with pytest.raises(InputError, match=r"frame-000001.color.png.*16×12.*8×6"):
        open_dataset(folder).frame(1)


def test_the_time_of_a_frame_comes_from_the_frame_rate(folder):
    assert open_dataset(folder).timestamp_s(2) == pytest.approx(2 / 30)


def test_a_frame_that_the_dataset_does_not_have_is_refused_with_those_that_it_has(folder):
    with pytest.raises(InputError, match=r"no frame 7; its frames are 0 to 2"):
        open_dataset(folder).color(7)


def test_layers_that_were_written_are_read_and_others_are_refused(folder):
    path = folder / "dataset.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"layers": ["normals", "sensor_depth", "right_color"]}))
    normals = np.zeros((6, 8, 3), np.float32)
    normals[1:, :, 2] = -1
    write_layer = LAYERS["normals"].encode
    write_layer(layer_file(folder, "normals", 1), normals)
    write_depth(layer_file(folder, "sensor_depth", 1), np.full((6, 8), 1.25), metres_per_step=0.0001)
    write_color(layer_file(folder, "right_color", 1), np.full((6, 8, 3), 7, np.uint8))
    dataset = open_dataset(folder)
    assert dataset.layers == ("normals", "sensor_depth", "right_color")
    np.testing.assert_allclose(dataset.read_layer("normals", 1), normals, atol=1e-4)
    np.testing.assert_allclose(dataset.read_layer("sensor_depth", 1), 1.25, atol=1e-6)
    np.testing.assert_array_equal(dataset.read_layer("right_color", 1), 7)
    with pytest.raises(InputError, match=r"no layer 'masks'; its layers are: normals, sensor_depth, right_color"):
        dataset.read_layer("masks", 1)


def test_a_sensors_depth_can_stand_for_depth(folder):
    path = folder / "dataset.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"layers": ["sensor_depth", "right_depth"]}))
    dataset = open_dataset(folder)
    noisy = dataset.depth(0) + 0.01 * (dataset.depth(0) > 0)
    write_depth(layer_file(folder, "sensor_depth", 0), noisy, metres_per_step=dataset.depth_scale)
    seen = dataset.with_depth_layer("sensor_depth")
    np.testing.assert_allclose(seen.depth(0), noisy, atol=dataset.depth_scale / 2 + 1e-6)
    np.testing.assert_array_equal(seen.color(0), dataset.color(0))
    with pytest.raises(InputError, match=r"frame-000001\.depth\.png: the file is missing"):
        seen.require((0, 1))
    with pytest.raises(InputError, match="right_depth: not depth that the frames' own camera sees"):
        dataset.with_depth_layer("right_depth")


def test_an_empty_folder_and_no_folder_are_no_datasets(tmp_path):
    with pytest.raises(InputError, match="not a dataset"):
        open_dataset(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        open_dataset(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"frame_cuont": 3}, "frame_cuont: unknown key; did you mean frame_count"),
        ({"depth_scale": -1.0}, "depth_scale: .*greater than 0"),
        ({"depth_scale": "0.1"}, "depth_scale: .*valid number"),
        ({"version": 9}, "version"),
    ],
)
def test_a_wrong_key_in_the_metadata_is_named(folder, change, complaint):
    path = folder / "dataset.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=f"dataset.json: {complaint}"):
        open_dataset(folder)


def test_metadata_that_was_cut_short_is_refused(folder):
    path = folder / "dataset.json"
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(InputError, match=r"dataset.json: .*JSON"):
        open_dataset(folder)


def test_frames_that_lost_their_metadata_are_told_as_such(folder):
    (folder / "dataset.json").unlink()
    with pytest.raises(
        InputError, match=r"dataset\.json: the file is missing.*name .*frames to read them as a 7-Scenes"
    ):
        open_dataset(folder)


def test_a_7_scenes_folder_opens_and_keeps_frames_that_lack_a_pose(folder):
    with pytest.raises(InputError, match=r"frames: these are the frames of the dataset .*; name that one"):
        open_dataset(folder / "frames")
    frames = (folder / "frames").rename(folder / "seq-01")
    (folder / "dataset.json").unlink()
    with pytest.raises(InputError, match=r"not a dataset, but holds some: seq-01; name one of them"):
        open_dataset(folder)
    (frames / "frame-000002.pose.txt").unlink()
    with pytest.raises(InputError, match=r"camera-intrinsics.txt: the file is missing.*8×6"):
        open_dataset(frames)
    (frames / "camera-intrinsics.txt").write_text("10 0 3.5\n0 10 2.5\n0 0 1\n")
    dataset = open_dataset(frames)
    assert dataset.format_name == "7-Scenes"
    assert dataset.frame_ids == (0, 1, 2)
    assert not dataset.is_complete(2)
    assert (dataset.camera.fx, dataset.camera.cx, dataset.camera.width, dataset.depth_scale) == (10.0, 3.5, 8, 0.001)


def test_the_summary_counts_and_measures(folder):
    (folder / "frames" / "frame-000002.pose.txt").unlink()
    summary = summarise(open_dataset(folder))
    assert (summary["frames_complete"], summary["frames_declared"]) == (2, 3)
    assert summary["depth"]["nearest_m"] == pytest.approx(1.0)
    assert summary["depth"]["farthest_m"] == pytest.approx(2.0)
    assert summary["trajectory"]["length_m"] == pytest.approx(2 * np.sin(0.5))
    assert summary["camera"]["horizontal_fov_deg"] == pytest.approx(np.degrees(2 * np.arctan(0.4)))
    json.dumps(summary, allow_nan=False)
    assert "2 complete of 3" in describe(summary)
