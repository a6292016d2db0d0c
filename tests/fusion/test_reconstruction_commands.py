import json
import shutil

import cv2
import numpy as np
import pytest
import trimesh
from synthetic_scene import CAMERA, DEPTH_SCALE, SphereScene, write_dataset

from datagen.images import read_color, read_depth
from fusion.cli import main
from fusion.render import resized
from fusion.volume import vdb_export

SCENE = SphereScene()


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """A dataset, its even frames fused, its odd ones, and all."""
    folder = tmp_path_factory.mktemp("base")
    data = write_dataset(folder / "data", SCENE.frames_around(8))
    for name, frames in (("even", "0::2"), ("odd", "1::2"), ("all", "::1")):
        arguments = [data, folder / name, "--voxel-size", 0.02, "--frames", frames]
        assert main(["reconstruct", *map(str, arguments)]) == 0
    return folder


def run(capsys, *arguments):
    code = main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def refused(capsys, out, message, *arguments):
    code, printed, errors = run(capsys, *arguments)
    assert code == 2
    assert printed == ""
    assert message in errors.replace("\n", "")
    assert errors.count("fusion: error:") == 1
    assert not out.exists()


def sphere_error(vertices):
    return np.abs(np.linalg.norm(vertices - np.array(SCENE.centre), axis=-1) - SCENE.radius)


@pytest.mark.parametrize(("frame", "share"), [(0, 0.9), (1, 0.5)])
def test_a_rendered_view_is_what_the_frame_saw(capsys, base, tmp_path, frame, share):
    # Frame 0 was fused. Frame 1 was not, so its pose comes from the dataset, and part of what it saw is missing.
    code, printed, _ = run(capsys, "render", base / "even", tmp_path / "view", "--frame", frame, "--json")
    assert code == 0
    view = json.loads(printed)
    assert view == json.loads((tmp_path / "view" / "view.json").read_text())
    size = (CAMERA.width, CAMERA.height)
    ours = read_depth(tmp_path / "view" / "depth.png", size=size, metres_per_step=view["depth_scale"])
    frames = base / "data" / "frames"
    theirs = read_depth(frames / f"frame-00000{frame}.depth.png", size=size, metres_per_step=DEPTH_SCALE)
    both = (ours > 0) & (theirs > 0)
    assert both.sum() > share * (theirs > 0).sum()
    assert np.median(np.abs(ours - theirs)[both]) < 0.1 * 0.02
    colors = read_color(tmp_path / "view" / "color.png", size=size)[both].astype(float)
    assert np.median(np.abs(colors - read_color(frames / f"frame-00000{frame}.color.png", size=size)[both])) <= 1
    normals = read_color(tmp_path / "view" / "normals.png", size=size)[both] / 127.5 - 1
    points = CAMERA.back_project(theirs)[both]
    pose = np.array(view["world_from_camera"])
    radial = (points @ pose[:3, :3].T + pose[:3, 3] - SCENE.centre) / SCENE.radius
    assert np.median((normals * radial).sum(-1)) > 0.98


def test_a_view_from_a_pose_file_in_another_size(capsys, base, tmp_path):
    shutil.copy(base / "data" / "frames" / "frame-000003.pose.txt", tmp_path / "pose.txt")
    arguments = ["render", base / "all", tmp_path / "view", "--pose", tmp_path / "pose.txt", "--size", "320x240"]
    assert run(capsys, *arguments)[0] == 0
    depth = cv2.imread(str(tmp_path / "view" / "depth.png"), cv2.IMREAD_UNCHANGED)
    assert depth.shape == (240, 320)
    assert (depth > 0).any()


def test_resizing_a_camera_keeps_the_edges_of_the_image():
    small = resized(CAMERA, (80, 60))
    for camera in (CAMERA, small):
        # Where the rays through the image's corners go.
        left, top = (-0.5 - camera.cx) / camera.fx, (-0.5 - camera.cy) / camera.fy
        right, bottom = (camera.width - 0.5 - camera.cx) / camera.fx, (camera.height - 0.5 - camera.cy) / camera.fy
        expected = [(-81.8) / 170, (-59.1) / 165, (159.5 - 81.3) / 170, (119.5 - 58.6) / 165]
        assert [left, top, right, bottom] == pytest.approx(expected)


def test_exports_go_by_the_suffix(capsys, base, tmp_path):
    assert run(capsys, "export", base / "all", tmp_path / "mesh.ply")[0] == 0
    assert run(capsys, "export", base / "all", tmp_path / "points.ply", "--points")[0] == 0
    mesh = trimesh.load(tmp_path / "mesh.ply", process=False)
    points = trimesh.load(tmp_path / "points.ply", process=False)
    np.testing.assert_array_equal(points.vertices, mesh.vertices)
    assert np.median(sphere_error(mesh.vertices)) < 0.1 * 0.02
    header = (tmp_path / "points.ply").read_bytes()[:400]
    assert b"property float nx" in header
    assert b"element face" not in header


def test_the_field_is_exported_where_there_is_openvdb(capsys, base, tmp_path):
    if vdb_export.importlib.util.find_spec("bpy") is None:
        pytest.skip("OpenVDB comes with Blender as a module, which is not here")
    assert run(capsys, "export", base / "all", tmp_path / "field.vdb")[0] == 0
    assert (tmp_path / "field.vdb").stat().st_size > 1000


def test_a_crop_is_a_reconstruction_of_its_own(capsys, base, tmp_path):
    middle = SCENE.centre[2]
    code, printed, _ = run(capsys, "crop", base / "all", tmp_path / "top", "--low", "_", "_", middle, "--json")
    assert code == 0
    record = json.loads(printed)
    assert record == json.loads((tmp_path / "top" / "reconstruction.json").read_text())
    assert record["config"]["crop"] == {"low": [None, None, middle], "high": [None, None, None]}
    vertices = trimesh.load(tmp_path / "top" / "mesh.ply", process=False).vertices
    assert vertices[:, 2].min() > middle - 1e-6
    assert np.median(sphere_error(vertices)) < 0.1 * 0.02
    # The other commands take it, its dataset included.
    assert run(capsys, "render", tmp_path / "top", tmp_path / "view", "--frame", 1)[0] == 0
    assert run(capsys, "crop", tmp_path / "top", tmp_path / "less", "--high", 0.1, 9, 9)[0] == 0


def test_merged_halves_are_the_whole(capsys, base, tmp_path):
    code, printed, _ = run(capsys, "merge", base / "odd", base / "even", tmp_path / "both", "--json")
    assert code == 0
    record = json.loads(printed)
    assert record["frames"] == 8
    assert [fused["frame"] for fused in record["trajectory"]] == list(range(8))
    merged, whole = (trimesh.load(folder / "mesh.ply", process=False) for folder in (tmp_path / "both", base / "all"))
    assert merged.area == pytest.approx(whole.area, rel=0.02)
    assert np.median(sphere_error(merged.vertices)) < 0.1 * 0.02
    assert run(capsys, "locate", tmp_path / "both", base / "data", "--frames", "0:2")[0] == 0


def test_bad_views_are_refused(capsys, base, tmp_path):
    view = tmp_path / "view"
    refused(capsys, view, "has no such frame; its frames are 0 to 7", "render", base / "all", view, "--frame", 99)
    refused(
        capsys, view, "pose.txt: the file is missing", "render", base / "all", view, "--pose", tmp_path / "pose.txt"
    )
    (tmp_path / "pose.txt").write_text("nan " * 16)
    refused(capsys, view, "the pose holds NaN", "render", base / "all", view, "--pose", tmp_path / "pose.txt")
    refused(capsys, view, "image size 0×5", "render", base / "all", view, "--frame", 0, "--size", "0x5")
    refused(capsys, view, "reconstruction.json: cannot be read", "render", tmp_path, view, "--frame", 0)


def test_bad_exports_are_refused(capsys, base, tmp_path):
    for name, message, *more in (
        ("out.obj", "ends in .ply"),
        ("out.vdb", "are for .ply", "--points"),
        ("out.vdb", "are for .ply", "--mesher", "dual-contouring"),
        ("out.ply", "no surface where weights are over 1000", "--min-weight", 1000),
        ("out.ply", "--min-weight nan: expected 0 or more", "--min-weight", "nan"),
    ):
        refused(capsys, tmp_path / name, message, "export", base / "all", tmp_path / name, *more)
    refused(capsys, tmp_path / "a.ply", "reconstruction.json: cannot be read", "export", tmp_path, tmp_path / "a.ply")


def test_bad_crops_are_refused(capsys, base, tmp_path):
    out = tmp_path / "out"
    for message, *box in (
        ("every low one less than its high one", "--low", 1, 1, 1, "--high", 0, 2, 2),
        ("expected three numbers each", "--low", "nan", 0, 0),
        ("nothing of the volume lies in this box", "--low", 5, 5, 5),
        ("but no surface", "--low", 0.05, -0.1, 0.54, "--high", 0.15, 0, 0.6),
    ):
        refused(capsys, out, message, "crop", base / "all", out, *box)
    code, _, errors = run(capsys, "crop", base / "all", base / "all", "--low", 0, 0, 0)
    assert code == 2
    assert "is read from; name another folder" in errors


def test_reconstructions_that_do_not_fit_together_are_refused(capsys, base, tmp_path):
    out, other = tmp_path / "out", write_dataset(tmp_path / "other", SCENE.frames_around(2))
    refused(capsys, out, "frame 0 is in", "merge", base / "even", base / "all", out)
    refused(capsys, out, "nothing to merge it with", "merge", base / "even", out)
    assert run(capsys, "reconstruct", other, tmp_path / "theirs", "--voxel-size", 0.02)[0] == 0
    refused(capsys, out, "only reconstructions of one dataset", "merge", base / "even", tmp_path / "theirs", out)
    arguments = ["reconstruct", base / "data", tmp_path / "coarse", "--voxel-size", 0.03, "--frames", "1::2"]
    assert run(capsys, *arguments)[0] == 0
    refused(
        capsys, out, "voxels of 0.03 m with a truncation of 0.12 m", "merge", base / "even", tmp_path / "coarse", out
    )


def test_a_crop_is_meshed_as_its_whole_was(capsys, base, tmp_path):
    arguments = ["reconstruct", base / "data", tmp_path / "often", "--voxel-size", 0.02, "--min-weight", 1]
    assert run(capsys, *arguments)[0] == 0
    assert run(capsys, "crop", tmp_path / "often", tmp_path / "crop", "--low", -1e-1, "-9e0", "_")[0] == 0
    whole, crop = (trimesh.load(tmp_path / name / "mesh.ply", process=False) for name in ("often", "crop"))
    inside = whole.vertices[:, 0] > -0.05
    assert (crop.vertices[:, 0] > -0.05).sum() == inside.sum()


@pytest.mark.parametrize("option", ["--no-drop-off", "--weighting=cosine", "--min-weight=0.5"])
def test_what_was_fused_differently_is_not_merged(capsys, base, tmp_path, option):
    arguments = ["reconstruct", base / "data", tmp_path / "other", "--voxel-size", 0.02, "--frames", "1::2", option]
    assert run(capsys, *arguments)[0] == 0
    name = option.lstrip("-").removeprefix("no-").split("=")[0].replace("-", "_")
    out = tmp_path / "out"
    refused(capsys, out, f"fused with {name}", "merge", base / "even", tmp_path / "other", out)
