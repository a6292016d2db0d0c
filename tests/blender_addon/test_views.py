"""Looking through the scan's camera."""

from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from blender_addon.files.reconstruction_files import read_record
from blender_addon.results.import_reconstruction import import_reconstruction
from blender_addon.results.look_through import neighbour, view_camera
from blender_addon.results.nearest_frames import frames_seeing
from blender_addon.results.scene_collection import REPLAY_PART, VIEW_PART, parts
from datagen.rigid import inverse, transform_points

pytestmark = pytest.mark.usefixtures("extension")


@pytest.fixture
def collection(extension: None, sphere_scan: Any) -> bpy.types.Collection:
    return import_reconstruction(bpy.context.scene, sphere_scan.folder)


def _poses(scan: Any) -> dict[int, np.ndarray]:
    return {item["frame"]: np.array(item["world_from_camera"]) for item in scan.record["trajectory"]}


def test_the_nearest_frame_that_sees_the_point_is_looked_through(
    sphere_scan: Any, collection: bpy.types.Collection
) -> None:
    """A point on the ball's surface: frames behind the ball are nearer to none, and do not see it."""
    poses = _poses(sphere_scan)
    centre = np.array([0.1, -0.2, 0.3])
    for frame in (0, 3, 7):
        towards = poses[frame][:3, 3] - centre
        bpy.context.scene.cursor.location = centre + 0.5 * towards / np.linalg.norm(towards)
        assert bpy.ops.scanback.look_through(target="CURSOR") == {"FINISHED"}
        camera = view_camera(collection)
        assert camera is not None
        assert camera["frame"] == frame
        assert bpy.context.scene.camera == camera
        assert camera.name == f"Frame {frame}"
        assert len(parts(collection, VIEW_PART)) == 1
        behind = [other for other in poses if (poses[other][:3, 3] - centre) @ towards < 0]
        ranking = list(camera["nearest_frames"])
        assert max(ranking.index(other) for other in poses if other not in behind) < min(map(ranking.index, behind)) + 3


def test_the_picture_behind_is_the_frames_own(sphere_scan: Any, collection: bpy.types.Collection) -> None:
    bpy.ops.scanback.look_through(target="FRAME", frame=4)
    camera = view_camera(collection)
    assert camera is not None
    (background,) = camera.data.background_images
    expected = sphere_scan.dataset / "frames" / "frame-000004.color.png"
    assert Path(bpy.path.abspath(background.image.filepath)) == expected
    bpy.context.view_layer.update()
    pixels = transform_points(inverse(_poses(sphere_scan)[4]), np.array(camera.matrix_world.translation))
    assert np.abs(pixels).max() < 1e-6  # the camera stands where the frame's did
    render = bpy.context.scene.render
    assert (render.resolution_x, render.resolution_y) == (160, 120)


def test_stepping_goes_through_the_frames_in_order_and_back(sphere_scan: Any, collection: bpy.types.Collection) -> None:
    bpy.ops.scanback.look_through(target="FRAME", frame=4)
    camera = view_camera(collection)
    assert camera is not None
    ranking = list(camera["nearest_frames"])
    assert ranking[0] == 4
    assert sorted(ranking) == sorted(_poses(sphere_scan))
    tooltip = bpy.types.SCANBACK_OT_step_view.description
    step = type("Step", (), {"step": 1})
    assert tooltip(bpy.context, step) == f"From frame 4 to frame {ranking[1]}, the next nearest"
    picture = camera.data.background_images[0]
    picture.display_depth, picture.alpha = "FRONT", 0.75  # how it is shown is the user's
    for expected in ranking[1:3]:
        assert bpy.ops.scanback.step_view(step=1) == {"FINISHED"}
        assert camera["frame"] == expected
        (picture,) = camera.data.background_images
        assert (picture.display_depth, picture.alpha) == ("FRONT", 0.75)
    bpy.ops.scanback.step_view(step=-1)
    assert camera["frame"] == ranking[1]
    bpy.ops.scanback.step_view(step=-1)
    with pytest.raises(RuntimeError, match="Frame 4 is the last in this direction"):
        bpy.ops.scanback.step_view(step=-1)
    assert neighbour(camera, -1) is None


def test_the_selection_and_a_query_lead_to_frames_too(sphere_scan: Any, collection: bpy.types.Collection) -> None:
    with pytest.raises(RuntimeError, match="Nothing is selected"):
        bpy.ops.scanback.look_through(target="SELECTION")
    marker = next(item for item in collection.all_objects if item.get("query") == 8 and item.type == "CAMERA")
    bpy.context.view_layer.objects.active = marker
    query: Any = type("Query", (), {"target": "QUERY"})
    tooltip = bpy.types.SCANBACK_OT_look_through.description(bpy.context, query)
    assert tooltip == "Frame 7, which is nearest to query 8, with its picture behind what is there"
    assert bpy.ops.scanback.look_through(target="QUERY") == {"FINISHED"}
    camera = view_camera(collection)
    assert camera is not None
    assert camera["frame"] == 7
    marker.select_set(True)
    assert bpy.ops.scanback.look_through(target="SELECTION") == {"FINISHED"}


def test_a_camera_goes_the_way_of_the_scan_again(sphere_scan: Any, collection: bpy.types.Collection) -> None:
    scene = bpy.context.scene
    scene.frame_start = 11
    for _ in range(2):  # the second replaces the first
        assert bpy.ops.scanback.replay() == {"FINISHED"}
    (camera,) = parts(collection, REPLAY_PART)
    assert scene.camera == camera
    assert len(bpy.data.actions) == 1
    for frame, pose in _poses(sphere_scan).items():
        scene.frame_set(11 + frame)
        seen = np.array(camera.matrix_world)
        np.testing.assert_allclose(seen[:3, 3], pose[:3, 3], atol=1e-5)
        np.testing.assert_allclose(-seen[:3, 2], pose[:3, 2], atol=1e-5)
        np.testing.assert_allclose(-seen[:3, 1], pose[:3, 1], atol=1e-5)
    assert scene.frame_end == 11 + max(_poses(sphere_scan))
    (background,) = camera.data.background_images
    assert background.image.source == "SEQUENCE"
    assert background.image_user.frame_start == 11
    assert background.image_user.frame_duration == 12


def test_a_dataset_alone_is_replayed(sphere_scan: Any) -> None:
    assert bpy.ops.scanback.import_dataset(directory=str(sphere_scan.dataset)) == {"FINISHED"}
    collection = bpy.context.scene.collection.children["Scanback dataset"]
    assert sorted(item.type for item in collection.all_objects) == ["CAMERA", "CURVE"]
    assert bpy.ops.scanback.replay() == {"FINISHED"}
    assert bpy.ops.scanback.look_through(target="FRAME", frame=5) == {"FINISHED"}
    camera = view_camera(collection)
    assert camera is not None
    (background,) = camera.data.background_images
    assert background.image.filepath.endswith("frame-000005.color.png")
    (sphere_scan.dataset / "frames" / "frame-000002.pose.txt").write_text("1 2 3")
    with pytest.raises(RuntimeError, match=r"frame-000002\.pose\.txt: no 4×4 pose"):
        bpy.ops.scanback.import_dataset(directory=str(sphere_scan.dataset))


def test_frames_that_show_the_point_come_first_and_the_nearest_before_all(sphere_scan: Any) -> None:
    record = read_record(sphere_scan.folder)
    poses = {fused.frame: fused.world_from_camera for fused in record.trajectory}
    kinds = set()
    for point in np.random.default_rng(2).uniform(-1.5, 1.5, (40, 3)):
        order = frames_seeing(point, record.trajectory, record.intrinsics)
        shown = [_shows(sphere_scan.camera, poses[frame], point) for frame in order]
        assert shown == sorted(shown, reverse=True)
        distances = np.array([np.linalg.norm(poses[frame][:3, 3] - point) for frame in order])
        for part in (distances[: sum(shown)], distances[sum(shown) :]):
            assert (np.diff(part) >= 0).all()
        assert sorted(order) == sorted(poses)
        kinds.update(shown)
    assert kinds == {True, False}
    visible = frames_seeing(np.zeros(3), record.trajectory, record.intrinsics, is_visible=lambda place: place[0] > 0)
    assert poses[visible[0]][0, 3] > 0


def _shows(camera: Any, world_from_camera: np.ndarray, point: np.ndarray) -> bool:
    seen = transform_points(inverse(world_from_camera), point)
    if seen[2] <= 0:
        return False
    u, v = camera.project(seen)
    return bool(-0.5 <= u <= camera.width - 0.5 and -0.5 <= v <= camera.height - 0.5)


def test_without_a_reconstruction_there_is_nothing_to_look_at() -> None:
    with pytest.raises(RuntimeError, match="The scene has no reconstruction"):
        bpy.ops.scanback.replay()
