import numpy as np
import pytest
import trimesh
from preview_datasets import CAMERA, gray, write_dataset

from datagen.open_dataset import open_dataset
from datagen.preview.source import evenly, preview_source
from datagen.preview.trajectory_plot import frustum
from datagen.preview.world import plot_from_world, seen_points, surroundings
from datagen.rigid import inverse, look_at, transform_points


def test_a_frustum_ends_at_the_images_corners():
    pose = look_at([1, 2, 3], [0, 0.5, 0])
    edges = frustum(CAMERA, pose, depth=0.3)
    rays, rectangle = transform_points(inverse(pose), edges[:4]), transform_points(inverse(pose), edges[4:])
    np.testing.assert_allclose(rays[:, 0], 0, atol=1e-12)
    np.testing.assert_allclose(rays[:, 1, 2], 0.3)
    corners = [[-0.5, -0.5], [CAMERA.width - 0.5, -0.5], [CAMERA.width - 0.5, CAMERA.height - 0.5]]
    np.testing.assert_allclose(CAMERA.project(rays[:3, 1]), corners, atol=1e-9)
    np.testing.assert_allclose(rectangle[:, 0], rays[:, 1], atol=1e-12)
    np.testing.assert_allclose(rectangle[:, 1], np.roll(rays[:, 1], -1, axis=0), atol=1e-12)


def test_a_scene_of_ours_keeps_its_z_up(tmp_path):
    dataset = open_dataset(write_dataset(tmp_path / "ours"))
    rotation, z_is_up = plot_from_world(dataset, np.stack([dataset.world_from_camera(i) for i in dataset.frame_ids]))
    np.testing.assert_array_equal(rotation, np.eye(4))
    assert z_is_up


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 0, 1), (1, 0, 0), (0.5, 0.7, 0.5)])
def test_elsewhere_up_is_where_the_cameras_upper_sides_point(tmp_path, up):
    up = np.array(up, float) / np.linalg.norm(up)
    dataset = open_dataset(write_dataset(tmp_path / "foreign", foreign=True))
    aside = np.cross(up, [0.3, 0.4, -0.5])
    poses = np.stack([look_at(aside * (1 + i / 10) + 0.2 * up, np.zeros(3), up=up) for i in range(5)])
    rotation, z_is_up = plot_from_world(dataset, poses)
    np.testing.assert_allclose(rotation[:3, :3] @ rotation[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation[:3, :3]) == pytest.approx(1)
    assert (rotation[:3, :3] @ up)[2] > np.cos(np.radians(20))
    assert z_is_up == (tuple(up) == (0, 0, 1))


def test_seen_points_lie_on_what_was_seen(tmp_path):
    source = preview_source(open_dataset(write_dataset(tmp_path / "d")), (0, 1, 2))
    points, colors = seen_points(source)
    np.testing.assert_allclose(points[:, 2], 0, atol=1e-4)  # the floor z = 0
    assert len(points) == len(colors) > 1000
    np.testing.assert_allclose(np.unique(colors), [gray(i) / 255 for i in range(3)])


def test_of_a_mesh_without_end_only_what_was_seen_is_shown(tmp_path):
    folder = write_dataset(tmp_path / "d")
    floor = trimesh.Trimesh([[-50, -50, 0], [50, -50, 0], [0, 100, 0]], [[0, 1, 2]])
    (folder / "ground_truth").mkdir()
    floor.export(folder / "ground_truth" / "mesh.ply")
    source = preview_source(open_dataset(folder), (0, 1, 2))
    seen, _ = seen_points(source)
    around = surroundings(source, np.eye(4))
    assert around.meaning == "the true mesh"
    pad = 0.06 * np.ptp(seen, axis=0).max()
    assert (around.points >= seen.min(axis=0) - pad).all()
    assert (around.points <= seen.max(axis=0) + pad).all()


def test_frames_are_chosen_evenly_with_both_ends():
    assert evenly(tuple(range(100)), 4) == (0, 33, 66, 99)
    assert evenly((5, 7), 4) == (5, 7)
    assert len(set(evenly(tuple(range(13)), 12))) == 12
