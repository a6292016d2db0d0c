"""What somebody does in Blender's interface with what was scanned, and what is left when the extension goes."""

import cv2
import numpy as np
import pytest
from sphere_scan import make_sphere_scan


@pytest.fixture(scope="module")
def scan(desktop):
    return make_sphere_scan(desktop.shared / "ball")


@pytest.fixture(scope="module")
def seen(desktop, scan):
    return desktop.run("artist_session.py")


def test_blender_finds_nothing_that_its_policy_forbids(seen):
    assert seen["policy"] == []


def test_dropped_files_are_imported(seen):
    count, collections = seen["dropped reconstruction.json"]
    assert count == 6  # mesh, path, two cameras with their frusta
    assert "Scanback ball" in collections
    assert seen["dropped mesh.ply"][0] == 1
    assert "io.drop_import_file" not in seen["output"]  # Blender's warnings of what it cannot give to


@pytest.mark.parametrize("kind", ["MATERIAL", "RENDERED"])
def test_the_meshs_material_shows_the_colours_that_solid_shading_shows(desktop, seen, kind):
    """Each place in its own colour, if lighter or darker: Solid shows the attribute alone, without a material."""
    solid, shaded = (_colours(desktop.shared / seen[f"shading {name}"]) for name in ("SOLID", kind))
    strong = (solid[1] > 0.5) & (shaded[1] > 0.25)
    assert np.mean(strong[solid[1] > 0.5]) > 0.5
    turn = np.abs((solid[0] - shaded[0] + 180) % 360 - 180)[strong]
    assert np.median(turn) < 15  # degrees; by chance 90
    assert np.ptp(solid[0][strong]) > 180  # the ball has all colours


def test_the_cursors_nearest_frames_are_stepped_through(seen):
    shown, ranking = seen["looking"]
    assert shown == ranking[0]
    assert seen["stepped"] == ["FINISHED"]


def test_the_way_of_the_scan_is_gone_again(seen, scan):
    poses = {item["frame"]: item["world_from_camera"] for item in scan.record["trajectory"]}
    for frame, place in zip((0, 4, 9), seen["replay"], strict=True):
        assert place == pytest.approx([row[3] for row in poses[frame][:3]], abs=1e-5)


def test_a_saved_file_opens_with_relative_paths_to_what_is_there(seen):
    folder, images, kinds = seen["reopened"]
    assert folder == "//ball"
    assert images
    assert all(path.startswith("//ball/dataset/frames/") for path in images)
    assert all(seen["there"])
    assert kinds.count("MESH") == 2
    assert kinds.count("CURVE") == 3


def test_the_extension_leaves_nothing_but_what_it_made(seen):
    left = dict(seen["left"])
    assert left.pop("objects") == len(seen["reopened"][2])
    assert left == {"files": [], "code": [], "classes": [], "operators": [], "modules": [], "path": []}


def _colours(picture):
    """Return hue in degrees and saturation of a picture's middle, where the ball is."""
    image = cv2.imread(str(picture)).astype(np.float32) / 255
    hue, saturation, _ = cv2.split(cv2.cvtColor(image[300:700, 300:900], cv2.COLOR_BGR2HSV))
    return hue, saturation
