"""Each format's own files, read by a few lines that know nothing of ours, put a pixel's surface point onto that pixel.

Pixel (u, v) is at (u, v) where integer coordinates are pixel centres, and at (u + 0.5, v + 0.5) where the image's
corner is the origin: a half pixel that is lost or added twice shows here, though a round trip would hide it.
"""

import json

import numpy as np
import pytest
from converted_datasets import convert
from scipy.spatial.transform import Rotation

NUMBER = 3


def tum(folder, point):
    line = (folder / "groundtruth.txt").read_text().splitlines()[1 + NUMBER]
    _, *numbers = map(float, line.split())
    camera = Rotation.from_quat(numbers[3:]).as_matrix().T @ (point - numbers[:3])
    x, y, w = np.loadtxt(folder / "camera-intrinsics.txt") @ camera
    return x / w, y / w


def seven_scenes(folder, point):
    camera = np.linalg.inv(np.loadtxt(folder / f"frame-{NUMBER:06d}.pose.txt")) @ [*point, 1]
    x, y, w = np.loadtxt(folder / "camera-intrinsics.txt") @ camera[:3]
    return x / w, y / w


def bop(folder, point):
    entry = json.loads((folder / "scene_camera.json").read_text())[str(NUMBER)]
    camera_mm = np.reshape(entry["cam_R_w2c"], (3, 3)) @ (1000 * point) + entry["cam_t_w2c"]
    x, y, w = np.reshape(entry["cam_K"], (3, 3)) @ camera_mm
    return x / w, y / w


def colmap(folder, point):
    images = (folder / "sparse/0/images.txt").read_text().splitlines()
    w, x, y, z, *translation = map(float, images[2 + 2 * NUMBER].split()[1:8])
    camera = Rotation.from_quat([x, y, z, w]).apply(point) + translation
    fx, fy, cx, cy = map(float, (folder / "sparse/0/cameras.txt").read_text().splitlines()[1].split()[4:])
    return fx * camera[0] / camera[2] + cx, fy * camera[1] / camera[2] + cy


def nerfstudio(folder, point):
    content = json.loads((folder / "transforms.json").read_text())
    camera = np.linalg.inv(content["frames"][NUMBER]["transform_matrix"]) @ [*point, 1]
    x, y, ahead = camera[0], -camera[1], -camera[2]
    return content["fl_x"] * x / ahead + content["cx"], content["fl_y"] * y / ahead + content["cy"]


def open3d(folder, point):
    rows = (folder / "scene/trajectory.log").read_text().splitlines()[5 * NUMBER + 1 : 5 * NUMBER + 5]
    camera = np.linalg.inv([[float(word) for word in row.split()] for row in rows]) @ [*point, 1]
    matrix = json.loads((folder / "camera_intrinsic.json").read_text())["intrinsic_matrix"]
    fx, fy, cx, cy = (matrix[i] for i in (0, 4, 6, 7))
    return fx * camera[0] / camera[2] + cx, fy * camera[1] / camera[2] + cy


@pytest.mark.parametrize(
    ("name", "project", "centre"),
    [
        ("7scenes", seven_scenes, 0.0),
        ("tum", tum, 0.0),
        ("bop", bop, 0.0),
        ("open3d", open3d, 0.0),
        ("colmap", colmap, 0.5),
        ("nerfstudio", nerfstudio, 0.5),
    ],
)
def test_a_surface_point_projects_onto_its_pixel(source, tmp_path, name, project, centre):
    folder = convert(source, tmp_path / name, name)
    depth = source.depth(NUMBER)
    points_camera = source.camera.back_project(depth)
    pose = source.world_from_camera(NUMBER)
    some = np.argwhere(depth > 0)[::1500]
    assert len(some) > 5
    for v, u in some:
        point_world = pose[:3, :3] @ points_camera[v, u] + pose[:3, 3]
        assert project(folder, point_world) == pytest.approx((u + centre, v + centre), abs=1e-6)
