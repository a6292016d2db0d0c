import numpy as np
import pytest
import trimesh

from datagen.camera import PinholeCamera
from datagen.cli import main
from datagen.dataset_format import Intrinsics, Metadata, write_metadata
from datagen.dataset_writer import write_frame
from datagen.errors import InputError
from datagen.open_dataset import open_dataset
from datagen.point_cloud import dataset_points
from datagen.rigid import look_at

CAMERA = PinholeCamera(width=40, height=30, fx=35.0, fy=36.0, cx=20.25, cy=14.0)
GREEN, BLUE = (10, 200, 30), (20, 30, 220)


@pytest.fixture
def wall(tmp_path):
    """Two frames of the plane y = 0, green left of x = 0 and blue right of it; a corner without depth."""
    values = {name: getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    write_metadata(
        tmp_path,
        Metadata(
            frame_count=2,
            intrinsics=Intrinsics(**values),
            depth_scale=1e-4,
            frames_per_second=30,
            recipe={},
            provenance={},
        ),
    )
    for frame, position in enumerate([[0.1, -2, 0.3], [-0.4, -1.5, 0]]):
        pose = look_at(position, [0, 0, 0])
        rays = CAMERA.back_project(np.ones((30, 40))) @ pose[:3, :3].T
        depth = -pose[1, 3] / rays[..., 1]
        x = (pose[:3, 3] + rays * depth[..., None])[..., 0]
        depth[:5, :5] = 0
        color = np.where((x < 0)[..., None], GREEN, BLUE).astype(np.uint8)
        write_frame(tmp_path / "frames", frame, color=color, depth=depth, world_from_camera=pose, depth_scale=1e-4)
    return tmp_path


def test_points_lie_on_the_surface_with_its_colours(wall):
    cloud = dataset_points(open_dataset(wall), (0, 1))
    assert len(cloud.points_world) == 2 * (40 * 30 - 25)
    assert np.abs(cloud.points_world[:, 1]).max() < 1e-4
    left = cloud.points_world[:, 0] < 0
    np.testing.assert_array_equal(np.unique(cloud.colors[left], axis=0), [GREEN])
    np.testing.assert_array_equal(np.unique(cloud.colors[~left], axis=0), [BLUE])


def test_a_voxel_holds_the_mean_of_its_points(wall):
    dataset = open_dataset(wall)
    every = dataset_points(dataset, (0, 1))
    cloud = dataset_points(dataset, (0, 1), voxel_size=0.1)
    voxels = np.floor(every.points_world / 0.1).astype(int)
    means = {}
    for voxel in np.unique(voxels, axis=0):
        inside = (voxels == voxel).all(axis=1)
        means[tuple(voxel)] = (every.points_world[inside].mean(axis=0), every.colors[inside].mean(axis=0))
    assert len(cloud.points_world) == len(means)
    for point, color in zip(cloud.points_world, cloud.colors, strict=True):
        expected_point, expected_color = means[tuple(np.floor(point / 0.1).astype(int))]
        np.testing.assert_allclose(point, expected_point, atol=1e-9)
        np.testing.assert_allclose(color, expected_color, atol=0.5)


def test_a_voxel_that_is_too_small_for_the_scene_is_refused(wall):
    with pytest.raises(InputError, match="too small for points"):
        dataset_points(open_dataset(wall), (0,), voxel_size=1e-7)


def test_the_command_writes_what_other_programs_read(wall, tmp_path, capsys):
    assert main(["pointcloud", str(wall), str(tmp_path / "points.ply"), "--frames", "0:1", "--voxel-size", "0.05"]) == 0
    cloud = trimesh.load(tmp_path / "points.ply")
    assert f"{len(cloud.vertices)} points of 1 frames" in capsys.readouterr().out
    assert np.abs(cloud.vertices[:, 1]).max() < 1e-4
    assert len(np.unique(cloud.colors[:, :3], axis=0)) <= 3  # green, blue, and the voxels between
