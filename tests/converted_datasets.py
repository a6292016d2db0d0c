"""A dataset to convert, and the conversion of it, for tests of dataset formats."""

import numpy as np
import trimesh
from synthetic_scene import CAMERA, SphereScene, icosphere, write_dataset

from datagen.formats.convert import convert_dataset
from datagen.formats.registry import format_named
from datagen.open_dataset import open_dataset
from datagen.rigid import inverse

SCENE = SphereScene(wall_z=-0.4)


def rolled(pose, angle):
    """Turn a camera about its own axis, so that no axis of it stays level."""
    roll = np.eye(4)
    roll[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return pose @ roll


def write_source(folder, *, count=5, camera=CAMERA, **metadata):
    """Write a dataset of ours: a sphere before a wall, seen by cameras around it that are rolled, with a true mesh."""
    poses = [rolled(pose, 1.1 * i) for i, pose in enumerate(SCENE.poses_around(count))]
    frames = [SCENE.frame(i, pose, camera) for i, pose in enumerate(poses)]
    fields = {"frames_per_second": 24.0, "ground_truth_mesh": "ground_truth/mesh.ply", "recipe": {"name": "ball"}}
    write_dataset(folder, frames, camera, **(fields | metadata))
    vertices, triangles = icosphere(SCENE, 2)
    (folder / "ground_truth").mkdir()
    trimesh.Trimesh(vertices, triangles, process=False).export(folder / "ground_truth" / "mesh.ply")
    return open_dataset(folder)


def convert(dataset, folder, name, **options):
    """Convert a dataset and give the folder back."""
    convert_dataset(dataset, folder, format_named(name), **options)
    return folder


def assert_same_poses(found, expected, tolerance=1e-9):
    """Compare datasets frame by frame, in their order."""
    for a, b in zip(found.frame_ids, expected.frame_ids, strict=True):
        difference = inverse(found.world_from_camera(a)) @ expected.world_from_camera(b)
        np.testing.assert_allclose(difference, np.eye(4), atol=tolerance)
