import json

import numpy as np
import pytest
import trimesh
from synthetic_scene import CAMERA, write_dataset

from datagen.dataset import Frame
from datagen.errors import InputError
from datagen.rigid import look_at
from fusion.cli import main
from fusion.devices import resolve_device
from fusion.pose.stages import parse_stages
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

VOXEL = 0.01


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """24 views of three boxes on a circle, the even ones fused."""
    folder = tmp_path_factory.mktemp("boxes")
    boxes = [((0.5, 0.3, 0.2), (0, 0, 0)), ((0.1, 0.1, 0.5), (0.2, 0.1, 0.1)), ((0.3, 0.08, 0.1), (-0.2, -0.15, 0.15))]
    shape = trimesh.util.concatenate(
        [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in boxes]
    )
    mesh = Mesh(vertices=np.asarray(shape.vertices, np.float32), triangles=np.asarray(shape.faces, np.int32))
    angles = np.arange(24) * 2 * np.pi / 24
    poses = [look_at((np.cos(a), np.sin(a), 0.6 + 0.1 * np.sin(3 * a)), (0, 0, 0)) for a in angles]
    depths = cast_rays_at_mesh(mesh, CAMERA, poses, device=resolve_device("cpu"), depth_only=True).depth.numpy()
    frames = [
        Frame(
            frame_id=i,
            color=np.where(depth[..., None] > 0, np.uint8(120), np.uint8(0)).repeat(3, axis=-1),
            depth=depth,
            world_from_camera=pose,
        )
        for i, (depth, pose) in enumerate(zip(depths, poses, strict=True))
    ]
    data = write_dataset(folder / "data", frames, CAMERA)
    arguments = ["reconstruct", data, folder / "model", "--voxel-size", VOXEL, "--frames", "::2", "--device", "cpu"]
    assert main([str(argument) for argument in arguments]) == 0
    return folder


def located(scan, capsys, stages):
    arguments = ["locate", scan / "model", scan / "data", "--stages", stages, "--device", "cpu", "--json"]
    assert main([str(argument) for argument in arguments]) == 0
    poses = json.loads(capsys.readouterr().out)
    assert [pose["query"] for pose in poses] == list(range(1, 24, 2))
    return poses


def test_refined_with_depth_every_held_out_view_is_found_to_a_third_of_a_voxel(scan, capsys):
    for pose in located(scan, capsys, "nearest,depth"):
        refined = pose["refined"]
        assert refined["verdict"] == "found"
        assert refined["rotation_error_deg"] < 0.2
        assert refined["translation_error_m"] < VOXEL / 3
        assert pose["nearest"] == pose["nearest_frames"][0]
        assert pose["rotation_error_deg"] > 5  # the fused views themselves are some way off


def test_a_stage_that_declines_hands_the_pose_on_and_says_why(scan, capsys):
    for pose in located(scan, capsys, "nearest,epipolar,depth"):
        epipolar, depth = pose["refined"]["stages"]
        assert epipolar["declined"]  # boxes of one colour have no features
        assert epipolar["reason"]
        assert not depth["declined"]
        assert pose["refined"]["translation_error_m"] < VOXEL / 3


@pytest.mark.parametrize("stages", ["depth", "nearest,icp", "nearest,depth,depth", "", "nearest,"])
def test_stages_that_there_are_not_are_refused(stages):
    with pytest.raises(InputError, match="nearest first, then any of epipolar, silhouette, depth"):
        parse_stages(stages)


def test_stages_run_in_the_order_given():
    assert parse_stages("nearest,depth,silhouette") == ("nearest", "depth", "silhouette")
