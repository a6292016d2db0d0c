import json

import numpy as np
import pytest
from oracles import oracle

from datagen.errors import InputError
from datagen.open_dataset import open_dataset


@pytest.fixture
def folder(converted):
    return converted("colmap")


def edit(path, number, change):
    """Change a line, numbered from 1."""
    lines = path.read_text().splitlines()
    lines[number - 1] = change(lines[number - 1])
    path.write_text("\n".join(lines) + "\n")


def test_pycolmap_reads_the_same_cameras_and_poses(source, folder):
    pycolmap = oracle("pycolmap")
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    assert model.num_reg_images() == 5
    camera = model.cameras[1]
    ours = source.camera
    np.testing.assert_allclose(camera.params, [ours.fx, ours.fy, ours.cx + 0.5, ours.cy + 0.5], atol=1e-12)
    for i, image in enumerate(sorted(model.images.values(), key=lambda image: image.name)):
        pose = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        np.testing.assert_allclose(np.linalg.inv(pose), source.world_from_camera(i), atol=1e-12)


def test_pycolmap_projects_every_point_onto_the_centre_of_the_pixel_that_it_is_from(source, folder):
    """COLMAP puts pixel centres at +0.5: a half pixel too much or too little is a half pixel of error here."""
    pycolmap = oracle("pycolmap")
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    assert model.num_points3D() > 10_000
    errors = []
    for image in model.images.values():
        frame = int(image.name[6:12])
        depth, color = source.depth(frame), source.color(frame)
        for observed in list(image.points2D)[::97]:
            point = model.points3D[observed.point3D_id]
            u, v = np.asarray(observed.xy) - 0.5
            assert (u, v) == (int(u), int(v))
            assert depth[int(v), int(u)] > 0
            np.testing.assert_array_equal(point.color, color[int(v), int(u)])
            errors.append(np.abs(image.project_point(point.xyz) - observed.xy).max())
    assert len(errors) > 300
    assert max(errors) < 1e-4


def test_a_model_that_pycolmap_wrote_is_read(source, folder):
    pycolmap = oracle("pycolmap")
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    model.write_text(str(folder / "sparse" / "0"))
    opened = open_dataset(folder)
    for i in source.frame_ids:
        np.testing.assert_allclose(opened.world_from_camera(i), source.world_from_camera(i), atol=1e-9)
    assert opened.camera.cx == pytest.approx(source.camera.cx, abs=1e-9)


def test_a_binary_model_is_refused_with_the_command_that_makes_it_text(source, folder):
    pycolmap = oracle("pycolmap")
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    for path in (folder / "sparse" / "0").iterdir():
        path.unlink()
    model.write_binary(str(folder / "sparse" / "0"))
    with pytest.raises(InputError, match=r"sparse/0: a binary model; .*colmap model_converter .* --output_type TXT"):
        open_dataset(folder)


@pytest.mark.parametrize("place", ["sparse", "."])
def test_a_model_is_found_where_people_put_it(source, folder, place):
    for path in list((folder / "sparse" / "0").iterdir()):
        path.rename(folder / place / path.name)
    np.testing.assert_allclose(open_dataset(folder).world_from_camera(2), source.world_from_camera(2), atol=1e-12)


def test_an_image_without_points_has_an_empty_second_line(source, folder):
    images = folder / "sparse" / "0" / "images.txt"
    lines = images.read_text().splitlines()
    images.write_text("\n".join("" if i >= 2 and i % 2 else line for i, line in enumerate(lines)) + "\n")
    opened = open_dataset(folder)
    assert opened.frame_ids == (0, 1, 2, 3, 4)
    np.testing.assert_allclose(opened.world_from_camera(4), source.world_from_camera(4), atol=1e-12)


def test_an_image_name_may_have_spaces_and_folders(folder):
    images = folder / "sparse" / "0" / "images.txt"
    edit(images, 3, lambda line: line.replace("frame-000000.png", "left cam/my frame-000000.png"))
    for kind in ("images", "depth"):
        (folder / kind / "left cam").mkdir()
        (folder / kind / "frame-000000.png").rename(folder / kind / "left cam" / "my frame-000000.png")
    dataset = open_dataset(folder)
    assert all(dataset.is_complete(i) for i in dataset.frame_ids)


def test_a_simple_pinhole_camera_has_one_focal_length(folder):
    edit(folder / "sparse/0/cameras.txt", 2, lambda _: "1 SIMPLE_PINHOLE 160 120 150.5 80 60")
    camera = open_dataset(folder).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (150.5, 150.5, 79.5, 59.5)


@pytest.mark.parametrize(
    ("name", "number", "line", "complaint"),
    [
        ("cameras.txt", 2, "1 OPENCV 160 120 1 1 1 1 0 0 0 0", "line 2: camera model OPENCV distorts the image.*undis"),
        ("cameras.txt", 2, "1 PINHOLE 160 120 170 165 80", "line 2: found 7 fields, expected 8: .*fx fy cx cy"),
        ("cameras.txt", 2, "1 PINHOLE 160 x 170 165 80 60", "line 2: found 'x' as HEIGHT"),
        ("cameras.txt", 2, "2 PINHOLE 160 120 170 165 80 60", "images.txt, line 3: CAMERA_ID 1 is not in cameras.txt"),
        ("cameras.txt", 2, "1 PINHOLE 160 120 0.01 165 80 60", "cameras.txt, line 2: camera: fx 0.01"),
        ("images.txt", 5, "2 1 0 0 0 0 0 0 1", "line 5: found 9 fields, expected 10: IMAGE_ID QW QX QY QZ"),
        ("images.txt", 5, "2 0.5 0 0 0 0 0 0 1 a.png", "line 5: the quaternion .* has length 0.5, expected 1"),
        ("images.txt", 5, "2 1 0 0 0 0 0 inf 1 a.png", "line 5: holds NaN or infinity"),
        ("images.txt", 5, "2 1 0 0 0 0 0 0 1 frame-000000.png", "line 5: frame-000000.png has an entry.*in line 3"),
    ],
)
def test_a_malformed_line_is_named(folder, name, number, line, complaint):
    edit(folder / "sparse" / "0" / name, number, lambda _: line)
    with pytest.raises(InputError, match=complaint):
        open_dataset(folder)


def test_images_of_two_cameras_are_refused(folder):
    cameras = folder / "sparse" / "0" / "cameras.txt"
    cameras.write_text(cameras.read_text() + "2 PINHOLE 160 120 171 165 81.8 59.1\n")
    edit(folder / "sparse/0/images.txt", 5, lambda line: line.replace(" 1 frame", " 2 frame"))
    with pytest.raises(InputError, match=r"images.txt, line 5: its camera differs from that of frame-000000.png"):
        open_dataset(folder)


def test_a_model_without_depth_is_refused_with_the_way_to_give_it(folder):
    for path in (folder / "depth").glob("*.png"):
        path.unlink()
    with pytest.raises(InputError, match=r"depth/frame-000000.png: missing.*metres_per_step.*depth/depth.json"):
        open_dataset(folder)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (None, r"depth.json: the file is missing"),
        ({}, r"depth.json: metres_per_step: found None, expected 1 finite number"),
        ({"metres_per_step": 0}, r"depth.json: metres_per_step: found 0, expected more than 0"),
    ],
)
def test_depth_of_an_unknown_scale_is_refused(folder, content, complaint):
    path = folder / "depth" / "depth.json"
    path.unlink() if content is None else path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=complaint):
        open_dataset(folder)


def test_an_empty_model_is_refused(folder):
    (folder / "sparse" / "0" / "images.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match=r"images.txt: holds no image"):
        open_dataset(folder)
