"""Scan, fuse, locate and compare, as the panel's buttons and as scripts do them."""

import json
import math
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest
import trimesh

import blender_addon
from blender_addon.errors import ReconstructionError
from blender_addon.files.ply_mesh import read_colored_mesh
from blender_addon.jobs import runner
from blender_addon.jobs.job import Pace, State
from blender_addon.results.error_colors import ERROR_COLORS, ERROR_METRES, NUMBERS_KEY, put_errors
from blender_addon.results.scene_collection import LIVE_PART, MESH_PART, PART_KEY, our_collections, parts
from blender_addon.results.scene_units import metres_per_unit
from blender_addon.settings import FuseProperties, ScanProperties
from blender_addon.steps import reasons
from blender_addon.steps.compare import triangles_of
from blender_addon.steps.evaluation import evaluated_as_shown
from blender_addon.steps.fuse import fuse_work
from blender_addon.steps.scan_source import write_source
from blender_addon.steps.scene_reference import remember
from datagen.open_dataset import open_dataset
from datagen.rigid import transform_points

VOXEL = 0.06
UNIT = 0.01
"""Metres in a unit of the scene, which has centimetres under inches and feet."""
SINGLE = 1e-5
"""What single precision leaves of a point ten units away, after some twenty roundings of 2**-24 each."""
SIZE = {"width": 64, "height": 48}


@pytest.fixture(scope="module")
def extension() -> Iterator[None]:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    blender_addon.register()
    yield
    blender_addon.unregister()
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.fixture(scope="module")
def scanned(extension: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan of a scene in centimetres and inches: an object turned, mirrored, sheared and smoothed by a modifier."""
    folder = tmp_path_factory.mktemp("project") / "scan"
    scene = _scene()
    bpy.ops.scanback.scan(folder=str(folder), frames=10, preset="draft", trajectory="HEMISPHERE", **SIZE)
    assert scene.name in bpy.data.scenes
    return folder


@pytest.fixture(scope="module")
def fused(scanned: Path) -> Path:
    scene = bpy.context.scene
    scene.scanback.folder = str(scanned)
    _fuse_as_the_button_does(scanned)
    return scanned


def _scene() -> bpy.types.Scene:
    scene = bpy.context.scene
    scene.unit_settings.system = "IMPERIAL"
    scene.unit_settings.scale_length = UNIT
    bpy.ops.mesh.primitive_monkey_add(size=1.5, location=(0.4, -0.3, 0.2))
    head = bpy.context.active_object
    head.name = "Original"
    head.rotation_euler = (0.3, 0.2, 1.0)
    head.scale = (-1.5, 0.8, 1.1)
    parent = bpy.data.objects.new("Parent", None)
    scene.collection.objects.link(parent)
    parent.location, parent.rotation_euler, parent.scale = (0.2, 0.1, 0.4), (0.1, -0.5, 0.2), (1.0, 1.3, 0.9)
    head.parent = parent
    modifier = head.modifiers.new("Subdivision", "SUBSURF")
    modifier.levels = modifier.render_levels = 1
    return scene


def _fuse_as_the_button_does(folder: Path) -> None:
    """The button begins the job and returns; ticks do the rest, and none of them takes long.

    Without a window Blender invokes no operators: what the button's does is done here.
    """
    settings = bpy.context.scene.scanback.fuse
    settings.voxel_size, settings.every, settings.device = VOXEL, 2, "cpu"
    assert reasons.why_not_fuse(bpy.context) is None
    chosen = {name: getattr(settings, name) for name in FuseProperties.__annotations__}
    job = runner.start("Fuse", fuse_work(remember(bpy.context.scene), folder, folder / "dataset", chosen))
    assert reasons.why_not_fuse(bpy.context) == "Fuse is running"
    stages, longest, grew = set(), 0.0, False
    original = bpy.data.objects["Original"]
    assert original.visible_get()
    while not job.is_over:
        began = time.thread_time()
        pace = runner.advance()
        longest = max(longest, time.thread_time() - began)
        stages.add(job.log.stage)
        grows = any(item.get(PART_KEY) == LIVE_PART for item in bpy.data.objects)
        assert not (grows and original.visible_get())  # they would flicker
        grew = grew or grows
        time.sleep(0.005 if pace is Pace.WAIT else 0)
    assert job.state is State.DONE, (job.message, list(job.log.lines))
    assert "integrate" in stages
    assert longest < 0.05
    assert not original.visible_get()
    assert "the original is hidden" in job.message
    assert not any(item.get(PART_KEY) == LIVE_PART for item in bpy.data.objects)
    assert not any("live" in mesh.name for mesh in bpy.data.meshes)


def _offsets(points: np.ndarray) -> np.ndarray:
    """Return how far points (N, 3) of the scene are from the original's surface, by Blender's own nearest point."""
    original = bpy.data.objects["Original"]
    offsets = []
    with evaluated_as_shown([original]) as depsgraph:  # it is hidden behind its reconstruction
        shown = original.evaluated_get(depsgraph)
        world_from_object = np.array(shown.matrix_world)
        object_from_world = np.linalg.inv(world_from_object)
        for point in points @ object_from_world[:3, :3].T + object_from_world[:3, 3]:
            found, place, _, _ = shown.closest_point_on_mesh(tuple(map(float, point)))
            assert found
            offsets.append(np.linalg.norm(world_from_object[:3, :3] @ (np.array(place) - point)))
    return np.array(offsets)


def _collection() -> bpy.types.Collection:
    (collection,) = our_collections(bpy.context.scene)
    return collection


def test_a_scan_is_a_dataset_with_all_that_is_needed_to_go_on(scanned: Path) -> None:
    metadata = json.loads((scanned / "dataset" / "dataset.json").read_bytes())
    assert metadata["frame_count"] == 10
    assert (metadata["intrinsics"]["width"], metadata["intrinsics"]["height"]) == (64, 48)
    assert len(list((scanned / "dataset" / "frames").glob("*.pose.txt"))) == 10
    assert sorted(path.name for path in (scanned / "source").iterdir()) == ["scan.json", "scan.toml", "scene.blend"]
    assert len(bpy.data.scenes) == 1


def test_a_scan_is_not_overwritten_unless_asked(scanned: Path) -> None:
    with pytest.raises(RuntimeError, match="holds a scan already"):
        bpy.ops.scanback.scan(folder=str(scanned), frames=2, **SIZE)
    assert len(list((scanned / "dataset" / "frames").glob("*.pose.txt"))) == 10


@pytest.mark.slow
def test_a_whole_scan_is_gone_on_with_in_no_time(scanned: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in (scanned / "dataset" / "frames").iterdir()}
    (scanned / "dataset" / "frames" / "frame-000004.pose.txt").unlink()
    assert bpy.ops.scanback.resume_scan(folder=str(scanned)) == {"FINISHED"}
    after = {path: path.stat().st_mtime_ns for path in (scanned / "dataset" / "frames").iterdir()}
    changed = {path.name for path in after if after[path] != before[path]}
    assert changed == {f"frame-000004.{part}" for part in ("color.png", "depth.png", "pose.txt")}


def test_the_mesh_lies_on_the_object_whatever_its_units_and_modifiers(fused: Path) -> None:
    mesh = read_colored_mesh(fused / "reconstruction" / "mesh.ply")
    (item,) = parts(_collection(), MESH_PART)
    assert np.array_equal(item.matrix_world, np.eye(4))
    points = np.empty((len(item.data.vertices), 3), np.float32)
    item.data.vertices.foreach_get("co", points.ravel())
    np.testing.assert_allclose(UNIT * points, mesh.vertices_world, rtol=1e-6)  # files are in metres
    offsets = _offsets(points[::7])
    assert np.mean(offsets) < VOXEL / 2
    assert np.quantile(offsets, 0.9) < VOXEL


def test_what_is_scanned_is_in_metres_whatever_the_scenes_units(scanned: Path) -> None:
    """Depth and pose put each pixel onto the original, by what Blender says of that, to half a step of the depth."""
    dataset = open_dataset(scanned / "dataset")
    assert dataset.metadata is not None
    half_step = 0.5 * dataset.metadata.depth_scale
    along_ray = np.sqrt(1 + (32 / dataset.camera.fx) ** 2 + (24 / dataset.camera.fy) ** 2)
    for frame in (dataset.frame(number) for number in (0, 3, 9)):
        points = dataset.camera.back_project(frame.depth)[frame.depth > 0]
        assert len(points) > 50
        offsets = _offsets(transform_points(frame.world_from_camera, points) / UNIT)
        assert UNIT * offsets.max() <= half_step * along_ray + SINGLE * UNIT
    truth = trimesh.load(scanned / "dataset" / "ground_truth" / "mesh.ply", process=False)
    vertices, triangles = triangles_of(bpy.data.objects["Original"])
    np.testing.assert_allclose(truth.bounds, UNIT * np.stack([vertices.min(0), vertices.max(0)]), rtol=1e-5)
    assert trimesh.Trimesh(vertices, triangles).volume > 0  # mirrored, and not inside out
    assert truth.volume == pytest.approx(UNIT**3 * trimesh.Trimesh(vertices, triangles).volume, rel=1e-4)


@pytest.mark.slow
def test_a_fuse_that_is_killed_leaves_the_older_result_in_its_place(fused: Path) -> None:
    def files() -> dict[str, int]:
        return {path.name: path.stat().st_mtime_ns for path in (fused / "reconstruction").iterdir()}

    before, shown = files(), [item.name for item in bpy.data.objects if item.visible_get()]
    settings = bpy.context.scene.scanback.fuse
    chosen = {name: getattr(settings, name) for name in FuseProperties.__annotations__}
    job = runner.start("Fuse", fuse_work(remember(bpy.context.scene), fused, fused / "dataset", chosen))
    while job.log.stage != "integrate":
        runner.advance()
        time.sleep(0.005)
        assert not job.is_over, job.message
    assert job.pid is not None
    os.kill(job.pid, signal.SIGKILL)
    while not job.is_over:
        runner.advance()
        time.sleep(0.005)
    assert job.state is State.FAILED
    assert job.message.startswith("The frames were not fused: the process was ended by the system or by hand")
    assert files() == before
    assert [item.name for item in bpy.data.objects if item.visible_get()] == shown
    assert not any(item.get(PART_KEY) == LIVE_PART for item in bpy.data.objects)
    assert reasons.why_not_fuse(bpy.context) is None
    assert bpy.ops.scanback.dismiss() == {"FINISHED"}


def test_a_reconstruction_in_the_scene_is_not_scanned_with_it(fused: Path, tmp_path: Path) -> None:
    settings = {name: getattr(bpy.context.scene.scanback.scan, name) for name in ScanProperties.__annotations__}
    write_source(bpy.context.scene, None, tmp_path, settings)
    with bpy.data.libraries.load(str(tmp_path / "scene.blend"), link=False) as (there, wanted):
        wanted.objects = there.objects
    meshes = {item.get(PART_KEY, item.name): item for item in wanted.objects if item.type == "MESH"}
    assert meshes.pop("mesh").hide_render
    assert not any(item.hide_render for item in meshes.values())
    assert len(meshes) == 1
    bpy.data.batch_remove(wanted.objects)
    assert not any(item.hide_render for item in _collection().all_objects)


def test_a_frame_is_located_where_it_was_left_out(fused: Path) -> None:
    assert bpy.ops.scanback.locate(folder=str(fused), query="FRAME", frame=3) == {"FINISHED"}
    cameras = [item for item in _collection().all_objects if item.type == "CAMERA" and "query" in item]
    assert [camera["query"] for camera in cameras] == [3]
    assert cameras[0]["nearest"] in (0, 2, 4, 6, 8)
    (background,) = cameras[0].data.background_images
    nearest = cameras[0]["nearest"]
    assert Path(bpy.path.abspath(background.image.filepath)).name == f"frame-{nearest:06d}.color.png"
    assert cameras[0].data.show_background_images
    assert tuple(background.image.size) == (64, 48)


def test_a_frame_that_is_not_there_is_told_in_plain_words(fused: Path) -> None:
    with pytest.raises(RuntimeError, match="There is no frame 10; the dataset's are 0 to 9"):
        bpy.ops.scanback.locate(folder=str(fused), query="FRAME", frame=10)


@pytest.mark.slow
def test_image_files_are_located_as_the_frame_that_they_are_from(fused: Path) -> None:
    frames = fused / "dataset" / "frames"
    metadata = json.loads((fused / "dataset" / "dataset.json").read_bytes())
    bpy.ops.scanback.locate(
        folder=str(fused),
        query="FILES",
        depth_file=str(frames / "frame-000004.depth.png"),
        color_file=str(frames / "frame-000004.color.png"),
        depth_scale=metadata["depth_scale"],
    )
    (camera,) = (item for item in _collection().all_objects if item.type == "CAMERA" and "query" in item)
    assert camera["nearest"] == 4


@pytest.mark.slow
def test_the_scenes_camera_is_located_where_it_stands(fused: Path) -> None:
    bpy.ops.scanback.look_through(target="FRAME", frame=6)
    assert bpy.context.scene.camera.name == "Frame 6"
    assert bpy.ops.scanback.locate(folder=str(fused), query="CAMERA") == {"FINISHED"}
    (camera,) = (item for item in _collection().all_objects if item.type == "CAMERA" and "query" in item)
    assert camera["nearest"] == 6


def test_errors_are_colors_with_numbers(fused: Path) -> None:
    collection = _collection()
    collection.name = "mine"  # names are the user's
    (item,) = parts(collection, MESH_PART)
    item.name = "renamed"
    assert bpy.ops.scanback.compare(folder=str(fused), truth="OBJECT", object_name="Original") == {"FINISHED"}
    data = item.data
    errors = np.empty(len(data.vertices), np.float32)
    data.attributes[ERROR_METRES].data.foreach_get("value", errors)
    numbers = item[NUMBERS_KEY]
    assert 0 < numbers["accuracy_m"] < UNIT * VOXEL / 2
    assert numbers["vertex_mean_m"] == pytest.approx(errors.mean())
    assert numbers["limit_m"] == pytest.approx(np.percentile(errors, 95))
    assert data.color_attributes.active_color.name == ERROR_COLORS
    colors = np.empty(4 * len(errors), np.float32)
    data.color_attributes[ERROR_COLORS].data.foreach_get("color_srgb", colors)
    colors = colors.reshape(-1, 4)
    worst, best = errors >= numbers["limit_m"], errors < 0.05 * numbers["limit_m"]
    np.testing.assert_allclose(colors[worst][:, :3], np.tile([[0xFD, 0xE7, 0x25]], (worst.sum(), 1)) / 255, atol=0.01)
    assert (colors[best][:, 0] < 0.3).all()
    assert bpy.ops.scanback.show_colors(errors=False) == {"FINISHED"}
    assert data.color_attributes.active_color.name == "Color"


@pytest.mark.slow
def test_a_mesh_that_was_deleted_is_brought_back_to_be_compared(fused: Path) -> None:
    (item,) = parts(_collection(), MESH_PART)
    bpy.data.objects.remove(item)
    bpy.ops.ed.undo_push(message="deleted")
    assert bpy.ops.scanback.compare(folder=str(fused)) == {"FINISHED"}
    (item,) = parts(_collection(), MESH_PART)
    assert ERROR_COLORS in item.data.attributes
    bpy.ops.ed.undo()
    assert not parts(_collection(), MESH_PART)  # bringing it back and colouring it are one step
    bpy.ops.ed.redo()


def test_a_mesh_that_was_edited_is_not_colored(fused: Path) -> None:
    (item,) = parts(_collection(), MESH_PART)
    errors = np.zeros(len(item.data.vertices) + 1, np.float32)
    with pytest.raises(ReconstructionError, match="it was edited; import the reconstruction again"):
        put_errors(item, errors, limit_m=0.0, numbers={})


def test_fusing_again_replaces_and_is_one_step_back(fused: Path) -> None:
    (before,) = parts(_collection(), MESH_PART)
    many = len(before.data.vertices)
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.scanback.fuse(folder=str(fused), voxel_size=2 * VOXEL, every=2, device="cpu", live=False)
    (after,) = parts(_collection(), MESH_PART)
    few = len(after.data.vertices)
    assert few < 0.5 * many
    assert len(our_collections(bpy.context.scene)) == 1
    bpy.ops.ed.undo()
    (item,) = parts(_collection(), MESH_PART)
    assert len(item.data.vertices) == many
    bpy.ops.ed.redo()
    (item,) = parts(_collection(), MESH_PART)
    assert len(item.data.vertices) == few


def test_what_is_not_there_is_told_and_harms_nothing(extension: None, tmp_path: Path) -> None:
    none = str(tmp_path / "none")
    for call, words in (
        (lambda: bpy.ops.scanback.fuse(folder=none), "no such folder; scan first"),
        (lambda: bpy.ops.scanback.locate(folder=none), "no such folder"),
        (lambda: bpy.ops.scanback.compare(folder=none), "no such folder"),
        (lambda: bpy.ops.scanback.resume_scan(folder=none), "no scan was begun here"),
        (lambda: bpy.ops.scanback.compare(folder=none, truth="OBJECT"), "No object is chosen"),
        (lambda: bpy.ops.scanback.locate(folder=none, query="VIEW"), "There is no 3D viewport here"),
    ):
        with pytest.raises(RuntimeError, match=words):
            call()
    assert not Path(none).exists()
    assert runner.current_job() is None


def test_a_scan_without_a_camera_or_a_place_is_refused(extension: None, tmp_path: Path) -> None:
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


@pytest.mark.usefixtures("extension")
def test_each_step_says_why_it_has_to_wait(tmp_path: Path) -> None:
    scene: Any = bpy.data.scenes.new("New")
    scene.scanback.folder = str(tmp_path / "new")
    mesh = bpy.data.meshes.new("Triangle")
    mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    item = bpy.data.objects.new("Triangle", mesh)
    scene.collection.objects.link(item)
    with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
        assert reasons.why_not_scan(bpy.context) is None
        scene.scanback.scan.trajectory = "CAMERA"
        assert reasons.why_not_scan(bpy.context) == "The scene has no camera to follow"
        assert reasons.why_not_fuse(bpy.context) == "Scan first, or choose a dataset"
        assert reasons.why_not_locate(bpy.context) == "Fuse first"
        assert reasons.why_not_compare(bpy.context) == "Fuse first"
    bpy.data.objects.remove(item)
    bpy.data.meshes.remove(mesh)
    bpy.data.scenes.remove(scene)


@pytest.mark.slow
def test_the_own_path_of_the_camera_is_scanned(extension: None, tmp_path: Path) -> None:
    scene = bpy.context.scene
    data = bpy.data.cameras.new("Path")
    camera = bpy.data.objects.new("Path", data)
    scene.collection.objects.link(camera)
    before = scene.camera, scene.frame_start, scene.frame_end
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
    scene.camera, scene.frame_start, scene.frame_end = before
