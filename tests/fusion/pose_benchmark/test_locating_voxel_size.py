import numpy as np
import pytest
from synthetic_scene import CAMERA, write_dataset

from datagen.dataset import Frame
from datagen.open_dataset import open_dataset
from fusion.pose_benchmark.scanned_subject import VOXELS_PER_EXTENT, locating_voxel_size


def walls(folder, places, depth):
    """Frames that see a wall straight before them, from places along x, metres."""
    frames = []
    for i, place in enumerate(places):
        pose = np.eye(4)
        pose[0, 3] = place
        frames.append(
            Frame(
                frame_id=i,
                color=np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8),
                depth=np.full((CAMERA.height, CAMERA.width), depth, np.float32),
                world_from_camera=pose,
            )
        )
    return open_dataset(write_dataset(folder, frames, CAMERA))


def test_a_model_to_locate_in_has_voxels_of_two_footprints(tmp_path):
    dataset = walls(tmp_path / "near", np.linspace(0, 0.1, 40), 0.8)
    assert locating_voxel_size(dataset, dataset.frame_ids) == pytest.approx(2 * 0.8 / CAMERA.fx, rel=0.05)


def test_a_large_scene_stays_affordable(tmp_path):
    dataset = walls(tmp_path / "wide", np.linspace(0, 100, 40), 0.8)
    # The box around nine tenths of the frames, the first and the last tenth left out.
    width = 0.8 * 100 + 0.8 * CAMERA.width / CAMERA.fx
    assert locating_voxel_size(dataset, dataset.frame_ids) == pytest.approx(width / VOXELS_PER_EXTENT, rel=0.05)
