import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from converted_datasets import SCENE

from datagen.errors import InputError
from datagen.open_dataset import open_dataset
from datagen.rigid import inverse, transform_points

YCBV = Path(__file__).parents[4] / "shared" / "data" / "ycbv"


@pytest.fixture
def folder(converted):
    return converted("bop")


def change(folder, number=1, **keys):
    path = folder / "scene_camera.json"
    content = json.loads(path.read_text())
    for key, value in keys.items():
        if value is None:
            content[str(number)].pop(key)
        else:
            content[str(number)][key] = value
    path.write_text(json.dumps(content))


def test_depth_times_its_scale_is_millimetres(source, folder):
    entry = json.loads((folder / "scene_camera.json").read_text())["2"]
    image = cv2.imread(str(folder / "depth" / "000002.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(image * entry["depth_scale"], 1000 * source.depth(2), atol=1e-3)


def test_the_true_mesh_is_the_scenes_object_and_lies_where_the_depth_is(source, folder):
    objects = json.loads((folder / "scene_gt.json").read_text())
    model = trimesh.load(folder / "models" / "obj_000001.ply", process=False)
    np.testing.assert_allclose(model.extents, [600, 600, 600], rtol=0.02)  # a ball of 0.3 m
    before_the_wall = [i for i in source.frame_ids if source.world_from_camera(i)[2, 3] > SCENE.wall_z]
    assert len(before_the_wall) >= 3
    for number in before_the_wall:
        entry = objects[str(number)][0]
        assert entry["obj_id"] == 1
        camera_mm = model.vertices @ np.reshape(entry["cam_R_m2c"], (3, 3)).T + entry["cam_t_m2c"]
        depth = source.depth(number)
        u, v = np.rint(source.camera.project(camera_mm)).astype(int).T
        inside = (u >= 0) & (u < 160) & (v >= 0) & (v < 120)
        seen = depth[v[inside], u[inside]] * 1000
        in_front = seen - camera_mm[inside, 2]
        # No vertex is nearer than what is seen there, but for outlines, where a rounded pixel sees past the ball.
        assert (in_front < 8).mean() > 0.95
        # From a distance d, (1 − r/d) / 2 = 35 % of a ball's surface is seen.
        assert (np.abs(in_front) < 8).mean() > 0.25


def test_a_scene_without_poses_opens_and_says_so(folder):
    for number in range(5):
        change(folder, number, cam_R_w2c=None, cam_t_w2c=None)
    dataset = open_dataset(folder)
    with pytest.raises(InputError, match=r"bop: frame 0 has no pose, and 5 of the 5"):
        dataset.require(dataset.frame_ids)


def test_jpeg_colour_and_gaps_in_the_numbers_are_read(source, folder):
    image = folder / "rgb" / "000003.png"
    cv2.imwrite(str(image.with_suffix(".jpg")), cv2.imread(str(image)))
    image.unlink()
    path = folder / "scene_camera.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps({key: content[key] for key in ("3", "0")}))
    opened = open_dataset(folder)
    assert opened.frame_ids == (0, 3)
    assert opened.color_file(3).suffix == ".jpg"
    assert opened.color(3).shape == source.color(3).shape


@pytest.mark.parametrize(
    ("keys", "complaint"),
    [
        ({"cam_K": [1, 2, 3]}, r"scene_camera.json: image 1: cam_K: found \[1, 2, 3\], expected 9 finite numbers"),
        ({"cam_K": [171, 0, 81.3, 0, 165, 58.6, 0, 0, 1]}, r"image 1: its cam_K differs from image 0's"),
        ({"depth_scale": None}, r"image 1: depth_scale: found None, expected 1 finite number"),
        ({"depth_scale": 0.2}, r"image 1: its depth_scale differs from image 0's"),
        ({"depth_scale": -1}, r"image 1: depth_scale: found -1, expected more than 0 and at most 10000"),
        ({"cam_t_w2c": None}, r"image 1: cam_t_w2c: found None, expected 3 finite numbers"),
        ({"cam_R_w2c": [2, 0, 0, 0, 2, 0, 0, 0, 2]}, r"image 1: cam_R_w2c: the pose is not rigid"),
    ],
)
def test_what_is_wrong_is_named_by_image_and_key(folder, keys, complaint):
    change(folder, **keys)
    with pytest.raises(InputError, match=complaint):
        open_dataset(folder)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("{}", r"scene_camera.json: holds no image"),
        ("[]", r"scene_camera.json: holds a list, expected an object"),
        ('{"one": {}}', r"scene_camera.json: 'one': expected an image number"),
        ('{"0": {"cam_K": [1,', r"scene_camera.json, line 1: not JSON"),
    ],
)
def test_a_malformed_file_is_refused(folder, text, complaint):
    (folder / "scene_camera.json").write_text(text)
    with pytest.raises(InputError, match=complaint):
        open_dataset(folder)


def test_a_scene_without_depth_is_refused(folder):
    for path in (folder / "depth").iterdir():
        path.unlink()
    with pytest.raises(InputError, match=r"depth/000000.png: missing, as the depth of all other images"):
        open_dataset(folder)


@pytest.fixture
def ycbv_scene(tmp_path):
    """Five real frames of YCB-Video, laid out as BOP by lines that know nothing of ours."""
    loadmat = pytest.importorskip("scipy.io").loadmat
    cameras = {}
    for number in range(1, 6):
        meta = loadmat(YCBV / f"{number:06d}-meta.mat")
        pose = meta["rotation_translation_matrix"]
        cameras[str(number)] = {
            "cam_K": meta["intrinsic_matrix"].ravel().tolist(),
            "depth_scale": 1000 / float(meta["factor_depth"].item()),
            "cam_R_w2c": pose[:3, :3].ravel().tolist(),
            "cam_t_w2c": (1000 * pose[:3, 3]).tolist(),
        }
        for name, folder in (("color", "rgb"), ("depth", "depth")):
            (tmp_path / folder).mkdir(exist_ok=True)
            (tmp_path / folder / f"{number:06d}.png").write_bytes((YCBV / f"{number:06d}-{name}.png").read_bytes())
    (tmp_path / "scene_camera.json").write_text(json.dumps(cameras))
    return tmp_path


@pytest.mark.skipif(not YCBV.is_dir(), reason="the frames of YCB-Video are not here")
def test_real_frames_agree_with_each_other_where_their_cameras_say(ycbv_scene):
    dataset = open_dataset(ycbv_scene)
    assert dataset.frame_ids == (1, 2, 3, 4, 5)
    assert dataset.depth_scale == pytest.approx(0.0001)
    first, last = dataset.frame(1), dataset.frame(5)
    points_world = transform_points(first.world_from_camera, dataset.camera.back_project(first.depth))[first.depth > 0]
    points_last = transform_points(inverse(last.world_from_camera), points_world)
    u, v = np.rint(dataset.camera.project(points_last)).astype(int).T
    inside = (u >= 0) & (u < dataset.camera.width) & (v >= 0) & (v < dataset.camera.height)
    there = last.depth[v[inside], u[inside]]
    difference = np.abs(there - points_last[inside, 2])[there > 0]
    assert inside.mean() > 0.9
    assert np.median(difference) < 0.004
