"""Scan, as the panel's button and as scripts do it."""

import json
import math
from pathlib import Path

import bpy
import numpy as np
import pytest
import trimesh
from scanned_project import Project

from blender_addon.results.scene_units import metres_per_unit
from blender_addon.steps.compare import triangles_of
from datagen.open_dataset import open_dataset
from datagen.rigid import transform_points

pytestmark = pytest.mark.usefixtures("extension")

SINGLE = 1e-5
"""What single precision leaves of a point ten units away, after some twenty roundings of 2**-24 each."""
SIZE = {"width": 64, "height": 48}


def test_a_scan_is_a_dataset_with_all_that_is_needed_to_go_on(project: Project) -> None:
    metadata = json.loads((project.folder / "dataset" / "dataset.json").read_bytes())
    assert metadata["frame_count"] == 10
    assert (metadata["intrinsics"]["width"], metadata["intrinsics"]["height"]) == (64, 48)
    assert len(list((project.folder / "dataset" / "frames").glob("*.pose.txt"))) == 10
    assert sorted(path.name for path in (project.folder / "source").iterdir()) == [
        "scan.json",
        "scan.toml",
        "scene.blend",
    ]
    assert len(bpy.data.scenes) == 1


def test_a_scan_is_not_overwritten_unless_asked(project: Project) -> None:
    with pytest.raises(RuntimeError, match="holds a scan already"):
        bpy.ops.scanback.scan(folder=str(project.folder), frames=2, **SIZE)
    assert len(list((project.folder / "dataset" / "frames").glob("*.pose.txt"))) == 10


@pytest.mark.slow
def test_a_whole_scan_is_gone_on_with_in_no_time(project: Project) -> None:
    before = {path: path.stat().st_mtime_ns for path in (project.folder / "dataset" / "frames").iterdir()}
    (project.folder / "dataset" / "frames" / "frame-000004.pose.txt").unlink()
    assert bpy.ops.scanback.resume_scan(folder=str(project.folder)) == {"FINISHED"}
    after = {path: path.stat().st_mtime_ns for path in (project.folder / "dataset" / "frames").iterdir()}
    changed = {path.name for path in after if after[path] != before[path]}
    assert changed == {f"frame-000004.{part}" for part in ("color.png", "depth.png", "pose.txt")}


def test_what_is_scanned_is_in_metres_whatever_the_scenes_units(project: Project) -> None:
    """Depth and pose put each pixel onto the original, by what Blender says of that, to half a step of the depth."""
    dataset = open_dataset(project.folder / "dataset")
    assert dataset.metadata is not None
    half_step = 0.5 * dataset.metadata.depth_scale
    along_ray = np.sqrt(1 + (32 / dataset.camera.fx) ** 2 + (24 / dataset.camera.fy) ** 2)
    for frame in (dataset.frame(number) for number in (0, 3, 9)):
        points = dataset.camera.back_project(frame.depth)[frame.depth > 0]
        assert len(points) > 50
        offsets = project.offsets(transform_points(frame.world_from_camera, points) / project.unit)
        assert project.unit * offsets.max() <= half_step * along_ray + SINGLE * project.unit
    truth = trimesh.load(project.folder / "dataset" / "ground_truth" / "mesh.ply", process=False)
    vertices, triangles = triangles_of(bpy.data.objects["Original"])
    np.testing.assert_allclose(truth.bounds, project.unit * np.stack([vertices.min(0), vertices.max(0)]), rtol=1e-5)
    assert trimesh.Trimesh(vertices, triangles).volume > 0  # mirrored, and not inside out
    assert truth.volume == pytest.approx(project.unit**3 * trimesh.Trimesh(vertices, triangles).volume, rel=1e-4)


def test_a_scan_without_a_camera_or_a_place_is_refused(tmp_path: Path) -> None:
    scene = bpy.data.scenes.new("Empty")
    with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
        with pytest.raises(RuntimeError, match="no object with a surface"):
            bpy.ops.scanback.scan(folder=str(tmp_path / "a"))
        with pytest.raises(RuntimeError, match="no active object"):
            bpy.ops.scanback.scan(folder=str(tmp_path / "a"), subject="OBJECT")
    bpy.data.scenes.remove(scene)
    bpy.ops.mesh.primitive_cube_add()
    cube = bpy.context.active_object
    camera, bpy.context.scene.camera = bpy.context.scene.camera, None
    (tmp_path / "file").write_text("")
    with pytest.raises(RuntimeError, match="The scene has no camera"):
        bpy.ops.scanback.scan(folder=str(tmp_path / "a"), trajectory="CAMERA")
    with pytest.raises(RuntimeError, match="cannot be written"):
        bpy.ops.scanback.scan(folder=str(tmp_path / "file" / "a"))
    bpy.context.scene.camera = camera
    bpy.data.objects.remove(cube)


@pytest.mark.slow
def test_the_own_path_of_the_camera_is_scanned(project: Project, tmp_path: Path) -> None:
    scene = bpy.context.scene
    data = bpy.data.cameras.new("Path")
    camera = bpy.data.objects.new("Path", data)
    scene.collection.objects.link(camera)
    scene.camera, scene.frame_start, scene.frame_end = camera, 1, 5
    camera.rotation_euler = (math.pi / 2, 0, 0)
    for frame, x in ((1, -1.0), (5, 1.0)):
        camera.location = (x, -8, 0.2)
        camera.keyframe_insert("location", frame=frame)
    bpy.ops.scanback.scan(folder=str(tmp_path), trajectory="CAMERA", frames=3, preset="draft", **SIZE)
    poses = [np.loadtxt(path) for path in sorted((tmp_path / "dataset" / "frames").glob("*.pose.txt"))]
    unit = metres_per_unit(scene)
    np.testing.assert_allclose([pose[0, 3] / unit for pose in poses], [-1, 0, 1], atol=1e-5)
    np.testing.assert_allclose(poses[0][:3, 2], [0, 1, 0], atol=1e-6)  # it looks along y
    assert bpy.ops.scanback.import_dataset(directory=str(tmp_path / "dataset")) == {"FINISHED"}
    replay = scene.camera
    assert replay != camera
    for frame, x in ((1, -1.0), (2, 0.0), (3, 1.0)):
        scene.frame_set(frame)
        np.testing.assert_allclose(replay.matrix_world.translation, (x, -8, 0.2), atol=1e-5)
