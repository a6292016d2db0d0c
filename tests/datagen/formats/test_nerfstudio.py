import json

import numpy as np
import pytest

from datagen.errors import InputError
from datagen.open_dataset import open_dataset


@pytest.fixture
def folder(converted):
    return converted("nerfstudio")


def change(folder, keys=(), **frame_keys):
    """Change keys of the file (a None removes one), and of its frame 1."""
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    for target, changes in ((content, dict(keys)), (content["frames"][1], frame_keys)):
        for key, value in changes.items():
            if value is None:
                target.pop(key, None)
            else:
                target[key] = value
    path.write_text(json.dumps(content))


def test_the_camera_looks_along_minus_z_with_y_up(source, folder):
    """nerfstudio's convention, in its documentation's words: +X right, +Y up, −Z the look-at direction."""
    matrix = np.array(json.loads((folder / "transforms.json").read_text())["frames"][2]["transform_matrix"])
    pose = source.world_from_camera(2)
    right, down, forward = pose[:3, :3].T
    np.testing.assert_allclose(matrix[:3, :3].T, [right, -down, -forward], atol=1e-15)
    np.testing.assert_allclose(matrix[:, 3], pose[:, 3], atol=1e-15)


def test_a_file_of_instant_ngp_has_an_angle_and_the_images_centre(folder):
    angle = 2 * np.arctan(80 / 150)
    change(folder, {"fl_x": None, "fl_y": None, "cx": None, "cy": None, "w": None, "h": None, "camera_angle_x": angle})
    camera = open_dataset(folder).camera
    assert (camera.fx, camera.fy) == pytest.approx((150, 150))
    assert (camera.cx, camera.cy, camera.width, camera.height) == (79.5, 59.5, 160, 120)


def test_without_a_scale_of_depth_it_is_millimetres_and_that_is_told(folder):
    change(folder, {"depth_unit_scale_factor": None})
    dataset = open_dataset(folder)
    assert dataset.depth_scale == 0.001
    assert any("nerfstudio's default" in note for note in dataset.notes)


def test_frames_are_in_the_order_of_their_numbers_whatever_the_files(source, folder):
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    content["frames"].reverse()
    path.write_text(json.dumps(content))
    opened = open_dataset(folder)
    assert opened.frame_ids == (0, 1, 2, 3, 4)
    np.testing.assert_allclose(opened.world_from_camera(3), source.world_from_camera(3), atol=1e-12)


def test_a_frame_may_repeat_the_camera_but_not_change_it(folder):
    change(folder, fl_x=170.0, cx=81.8)
    assert open_dataset(folder).camera.fx == 170
    change(folder, fl_x=171.0)
    with pytest.raises(InputError, match=r"transforms.json: frames\[1\]: its camera .* differs from frames\[0\]'s"):
        open_dataset(folder)


@pytest.mark.parametrize(
    ("keys", "frame_keys", "complaint"),
    [
        ({"k1": 0.01}, {}, r"transforms.json: k1: 0.01 distorts the image; undistort"),
        ({"camera_model": "OPENCV_FISHEYE"}, {}, r"camera_model: 'OPENCV_FISHEYE' is not a pinhole camera"),
        ({"fl_x": None}, {}, r"transforms.json: has neither fl_x nor camera_angle_x"),
        ({"fl_x": "wide"}, {}, r"transforms.json: fl_x: found 'wide', expected 1 finite number"),
        ({"w": 320}, {}, r"transforms.json: w, h: found 320, 120, but the depth images are 160×120"),
        ({"fl_x": -5.0}, {}, r"transforms.json: camera: fx -5"),
        ({"depth_unit_scale_factor": 0}, {}, r"depth_unit_scale_factor: found 0, expected more than 0 and at most 10"),
        ({"frames": []}, {}, r"transforms.json: frames: expected a list of objects, at least one"),
        ({}, {"depth_file_path": None}, r"frames\[1\]: has no depth_file_path"),
        ({}, {"file_path": 7}, r"frames\[1\]: file_path: found 7, expected the path"),
        ({}, {"transform_matrix": [[1, 2], [3, 4]]}, r"frames\[1\]: transform_matrix: found .*expected 16 finite"),
        ({}, {"transform_matrix": np.diag([2.0, 2, 2, 1]).tolist()}, r"frames\[1\]: transform_matrix: .*not rigid"),
        ({}, {"file_path": "images/frame_000000.png"}, r"frames: 1 of them repeat another one's file_path"),
    ],
)
def test_what_cannot_be_used_is_named_by_frame_and_key(folder, keys, frame_keys, complaint):
    if keys.get("frames") == []:
        (folder / "transforms.json").write_text(json.dumps(keys))
    else:
        change(folder, keys, **frame_keys)
    with pytest.raises(InputError, match=complaint):
        open_dataset(folder)


def test_json_that_was_cut_short_is_refused_by_line(folder):
    path = folder / "transforms.json"
    path.write_text(path.read_text()[:300])
    with pytest.raises(InputError, match=r"transforms.json, line \d+: not JSON"):
        open_dataset(folder)
