import json

import cv2
import numpy as np
import pytest
from three_balls import CAMERA, POSES, see

from datagen.errors import InputError
from fusion.pose.mask_source import MaskChoice
from fusion.pose.query_source import ImageFiles, image_query, read_camera

NUMBERS = tuple(str(value) for value in (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy))


@pytest.fixture
def files(tmp_path):
    depth = see(POSES[0])
    cv2.imwrite(str(tmp_path / "d.png"), np.rint(depth * 10000).astype(np.uint16))
    cv2.imwrite(str(tmp_path / "m.png"), (depth > 0).astype(np.uint8) * 255)
    cv2.imwrite(str(tmp_path / "c.png"), np.full((*depth.shape, 3), (10, 20, 30), np.uint8))
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((60, 80, 3), np.uint8))
    return tmp_path


def test_one_query_from_its_files(files):
    mask = MaskChoice(source=str(files / "m.png"))
    source = image_query(
        ImageFiles(color=files / "c.png", depth=files / "d.png", depth_scale=1e-4, intrinsics=NUMBERS, mask=mask)
    )
    assert source.camera == CAMERA
    query = source.read(0).query
    np.testing.assert_allclose(query.depth, see(POSES[0]), atol=6e-5)
    np.testing.assert_array_equal(query.mask, see(POSES[0]) > 0)
    assert query.color[0, 0].tolist() == [30, 20, 10]
    assert source.read(0).truth is None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, r"neither depth nor mask \(nothing\); give --depth FILE --depth-scale S, or --mask FILE"),
        ({"color": "c.png"}, "neither depth nor mask"),
        ({"depth": "d.png"}, r"how long is a step\? Give --depth-scale"),
        ({"depth": "d.png", "depth_scale": 0.0}, "--depth-scale 0: expected metres a step"),
        ({"depth": "d.png", "depth_scale": 1e-4}, "camera is not known; give --intrinsics FX FY CX CY"),
        ({"depth": "d.png", "depth_scale": 1e-4, "intrinsics": ("1", "2", "3")}, "expected four numbers"),
        ({"depth": "d.png", "depth_scale": 1e-4, "intrinsics": ("k.txt",)}, "k.txt: no such file"),
        (
            {"depth": "d.png", "depth_scale": 1e-4, "color": "small.png", "intrinsics": NUMBERS},
            r"small\.png: 80×60 pixels, but .*160×120",
        ),
        ({"mask": "layer"}, "only a dataset has layers"),
        ({"mask": "derived"}, "neither depth nor mask"),
        ({"mask": "small.png", "color": "c.png", "intrinsics": NUMBERS}, r"the mask has 80×60 pixels.*160×120"),
    ],
)
def test_what_is_missing_is_named_with_its_remedy(files, given, message):
    paths = {name: files / given[name] for name in ("color", "depth") if name in given}
    mask = given.get("mask")
    if mask is not None:
        paths["mask"] = MaskChoice(source=mask if mask in ("layer", "derived") else str(files / mask))
    rest = {name: given[name] for name in ("depth_scale", "intrinsics") if name in given}
    with pytest.raises(InputError, match=message):
        image_query(ImageFiles(**paths, **rest))


def test_a_camera_is_read_from_every_shape_that_is_usual(tmp_path):
    size = (CAMERA.width, CAMERA.height)
    matrix = [[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]]
    four = {name: getattr(CAMERA, name) for name in ("fx", "fy", "cx", "cy")}
    path = tmp_path / "camera.json"
    for content in (four, {"intrinsics": four}, {"cam_K": np.ravel(matrix).tolist()}, {"camera_matrix": matrix}):
        path.write_text(json.dumps(content))
        assert read_camera((str(path),), size=size) == CAMERA
    np.savetxt(tmp_path / "k.txt", matrix)
    assert read_camera((str(tmp_path / "k.txt"),), size=size) == CAMERA
    for content, message in (
        ({"width": 640, "height": 480, **four}, r"images of 640×480 pixels, the query has 160×120"),
        ({"K": [1, 2]}, "K: expected nine numbers"),
        ({"f": 1}, "holds no fx, fy, cx, cy"),
        ([1, 2], "holds no fx, fy, cx, cy"),
    ):
        path.write_text(json.dumps(content))
        with pytest.raises(InputError, match=message):
            read_camera((str(path),), size=size)
