import json

import cv2
import numpy as np
import pytest
import trimesh
from boxes import BOXES, boxes
from synthetic_scene import write_dataset
from three_balls import CAMERA, see
from three_balls import POSES as BALL_POSES

from datagen.dataset import Frame
from datagen.images import image_size
from datagen.rigid import inverse, look_at, rotation_angle_deg, transform_points
from fusion.cli import main
from fusion.devices import resolve_device
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

INTRINSICS = ("--intrinsics", CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
EYES = [0.8 * np.array(way) for way in ((0.5, -0.8, 0.3), (-0.5, -0.6, 0.6), (0.9, 0.4, -0.2))]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A model in millimetres, and a recording of it: the second frame is of something else, the third is empty."""
    folder = tmp_path_factory.mktemp("located")
    mesh = boxes()
    shape = trimesh.Trimesh(mesh.vertices * 1000, mesh.triangles, process=False)
    shape.export(folder / "boxes_mm.ply")
    poses = [look_at(eye, (0, 0, 0.02)) for eye in EYES]
    depths = list(cast_rays_at_mesh(mesh, CAMERA, poses, device=resolve_device("cpu"), depth_only=True).depth.numpy())
    depths[1] = see(BALL_POSES[1])
    depths[2] = np.zeros_like(depths[2])
    color = np.full((CAMERA.height, CAMERA.width, 3), 90, np.uint8)
    frames = [
        Frame(frame_id=i, color=color, depth=depth, world_from_camera=pose)
        for i, (depth, pose) in enumerate(zip(depths, poses, strict=True))
    ]
    write_dataset(folder / "data", frames, CAMERA)
    cv2.imwrite(str(folder / "mask.png"), (depths[0] > 0).astype(np.uint8))
    cv2.imwrite(str(folder / "empty.png"), np.zeros(depths[0].shape, np.uint8))
    return folder


def run(capsys, *arguments):
    code = main([str(argument) for argument in ("locate", *arguments)])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def test_a_cad_model_is_found_and_another_thing_and_nothing_are_not(capsys, folder):
    arguments = (folder / "boxes_mm.ply", folder / "data", "--model-scale", 0.001, "--device", "cpu", "--json")
    code, printed, errors = run(capsys, *arguments, "--out", folder / "found.json", "--picture", folder / "found.png")
    assert code == 0
    found, other, empty = json.loads(printed)
    assert json.loads(printed) == json.loads((folder / "found.json").read_text())
    assert found["verdict"] == "found"
    assert found["refined"]["rotation_error_deg"] < 0.2
    assert found["refined"]["translation_error_m"] < 0.001
    assert found["refined"]["quality"] > 0.95
    assert len(found["refined"]["uncertainty"]["covariance"]) == 6
    # The object's pose in the camera, for an object that moves: it brings the model's points to where depth is.
    camera_from_object = np.array(found["refined"]["camera_from_object"])
    np.testing.assert_allclose(camera_from_object @ found["refined"]["world_from_camera"], np.eye(4), atol=1e-9)
    truth = inverse(look_at(EYES[0], (0, 0, 0.02)))
    corners = boxes().vertices.astype(float)
    off = transform_points(camera_from_object, corners) - transform_points(truth, corners)
    assert np.abs(off).max() < 0.001
    for lost in (other, empty):
        assert lost["verdict"] == "not found"
        assert "world_from_camera" not in lost
        assert "world_from_camera" not in lost.get("refined", {})
    assert "no pixel has a valid depth" in empty["reasons"][0]
    assert "query 2, not found" in errors
    assert image_size(folder / "found.png") == (2 * CAMERA.width + 4, 3 * CAMERA.height + 8)


def test_one_image_with_a_mask_and_no_depth_is_located_by_its_outline(capsys, folder):
    code, printed, _ = run(
        capsys,
        *(folder / "boxes_mm.ply", "--model-scale", 0.001, "--mask", folder / "mask.png"),
        *(*INTRINSICS, "--device", "cpu", "--json"),
    )
    assert code == 0
    (found,) = json.loads(printed)
    assert found["verdict"] in ("found", "doubtful")  # boxes have outlines that fit from elsewhere, too
    assert found["refined"]["stages"][0]["stage"] == "silhouette"
    assert found["refined"]["evidence"]["covered"] > 0.95
    poses = [found["refined"], *found["refined"]["alternatives"]]
    truth = look_at(EYES[0], (0, 0, 0.02))
    turns = [rotation_angle_deg(inverse(np.array(pose["world_from_camera"])) @ truth) for pose in poses]
    assert min(turns) < 3


def test_an_empty_mask_is_not_found(capsys, folder):
    arguments = (folder / "boxes_mm.ply", "--model-scale", 0.001, "--device", "cpu", "--json", *INTRINSICS)
    code, printed, _ = run(capsys, *arguments, "--mask", folder / "empty.png")
    assert code == 0
    assert json.loads(printed) == [{"query": 0, "verdict": "not found", "reasons": ["the mask is empty"]}]


def test_inputs_that_cannot_be_meant_are_refused(capsys, folder):
    model, data = folder / "boxes_mm.ply", folder / "data"
    for arguments, message in (
        ((model, data), "the model is 519.6 m large"),
        ((model, data), "give --model-scale 0.001"),
        ((model, data, "--mask", "layer"), "has no masks"),
        ((model, data, "--object", "3"), "give --mask too"),
        ((model, data, "--color", "c.png"), "is for one image"),
        ((model, "--frames", "::2"), "name the dataset too"),
        ((model,), "name a DATASET"),
        ((model, "--mask", folder / "mask.png", *INTRINSICS, "--stages", "nearest,depth"), "depth needs depth"),
        ((model, "--mask", folder / "mask.png", *INTRINSICS, "--stages", "nearest,epipolar"), "epipolar needs colour"),
        ((folder / "none.ply", data), "no such file"),
        ((folder / "none", data), "reconstruction.json: cannot be read"),
        ((model, data, "--model-scale", 0.001, "--picture", "a.jpg"), "end the name in .png"),
    ):
        code, _, errors = run(capsys, *arguments, "--device", "cpu")
        assert code == 2
        assert message in errors
    assert len(BOXES) == 3
