"""What users do between two steps and during them: undo, redo, rename, delete, change the units."""

import time
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from blender_addon.files.reconstruction_files import read_record
from blender_addon.jobs import runner
from blender_addon.jobs.job import Job, Pace, State, Work
from blender_addon.results.import_reconstruction import import_reconstruction, place_located
from blender_addon.results.look_through import view_camera
from blender_addon.results.scene_collection import MESH_PART, our_collections, parts
from blender_addon.steps.bring_in import bring_in
from blender_addon.steps.scene_reference import remember

pytestmark = pytest.mark.usefixtures("extension")


def _vertices(item: Any) -> np.ndarray:
    points = np.empty((len(item.data.vertices), 3), np.float32)
    item.data.vertices.foreach_get("co", points.ravel())
    return points


def _begin_import(folder: Path) -> Job:
    scene = remember(bpy.context.scene)

    def work(job: Job) -> Work[str]:
        yield from bring_in(job, scene, folder, undo="Import")
        return "imported"

    return runner.start("Import", work)


def _finish(job: Job) -> None:
    end = time.monotonic() + 60
    while not job.is_over:
        assert time.monotonic() < end
        time.sleep(0.01 if runner.advance() is Pace.WAIT else 0)


def test_an_undo_while_a_mesh_comes_in_begins_it_again(sphere_scan: Any) -> None:
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.mesh.primitive_cube_add()
    bpy.ops.ed.undo_push(message="cube")
    job = _begin_import(sphere_scan.folder)
    while not any(mesh.name.startswith("Scanback") for mesh in bpy.data.meshes):
        time.sleep(0.01 if job.step() is Pace.WAIT else 0)
        assert not job.is_over
    assert bpy.ops.ed.undo() == {"FINISHED"}
    assert not bpy.data.meshes
    _finish(job)
    assert (job.state, job.message) == (State.DONE, "imported")
    (collection,) = our_collections(bpy.context.scene)
    (item,) = parts(collection, MESH_PART)
    np.testing.assert_array_equal(_vertices(item), sphere_scan.mesh.vertices.astype(np.float32))
    assert [mesh.name for mesh in bpy.data.meshes] == [item.data.name]


def test_a_reconstruction_is_taken_back_and_brought_again_by_one_step(sphere_scan: Any) -> None:
    bpy.ops.ed.undo_push(message="before")
    _finish(_begin_import(sphere_scan.folder))
    objects = sorted(item.name for item in bpy.context.scene.objects)
    assert len(objects) == 6
    bpy.ops.ed.undo()
    assert not bpy.context.scene.objects
    with pytest.raises(RuntimeError, match="The scene has no reconstruction"):
        bpy.ops.scanback.replay()
    bpy.ops.ed.redo()
    assert sorted(item.name for item in bpy.context.scene.objects) == objects
    _finish(_begin_import(sphere_scan.folder))
    assert sorted(item.name for item in bpy.context.scene.objects) == objects
    assert len(our_collections(bpy.context.scene)) == 1


def test_looking_through_a_frame_is_one_step_back_and_forth(sphere_scan: Any) -> None:
    collection = import_reconstruction(bpy.context.scene, sphere_scan.folder)
    bpy.ops.ed.undo_push(message="before")
    for _ in range(2):
        bpy.ops.scanback.look_through("EXEC_DEFAULT", True, target="FRAME", frame=4)
        bpy.ops.scanback.step_view("EXEC_DEFAULT", True, step=1)
        bpy.ops.ed.undo()
        (collection,) = our_collections(bpy.context.scene)
        camera = view_camera(collection)
        assert camera is not None
        assert camera["frame"] == 4
        bpy.ops.ed.undo()
        (collection,) = our_collections(bpy.context.scene)
        assert view_camera(collection) is None
        assert bpy.context.scene.camera is None
    bpy.ops.ed.redo()
    assert bpy.ops.scanback.step_view(step=1) == {"FINISHED"}


def test_the_steps_go_on_with_what_was_renamed_and_without_what_was_deleted(sphere_scan: Any) -> None:
    scene = bpy.context.scene
    collection = import_reconstruction(scene, sphere_scan.folder)
    scene.name = collection.name = "mine"
    for item in list(collection.all_objects):
        if item.type == "CURVE":
            bpy.data.objects.remove(item)
        else:
            item.name = item.data.name = "mine"
    bpy.data.collections.remove(collection.children[0])  # where the located frames are
    assert bpy.ops.scanback.look_through(target="FRAME", frame=4) == {"FINISHED"}
    assert bpy.ops.scanback.replay() == {"FINISHED"}
    assert place_located(scene, read_record(sphere_scan.folder)) == collection
    assert sum("query" in item for item in collection.all_objects) == 2
    bpy.data.objects.remove(view_camera(collection))
    with pytest.raises(RuntimeError, match="Look through a frame first"):
        bpy.ops.scanback.step_view(step=1)
    bpy.data.collections.remove(collection)
    assert place_located(scene, read_record(sphere_scan.folder)) is None
    assert bpy.ops.scanback.import_reconstruction(directory=str(sphere_scan.folder)) == {"FINISHED"}
    assert len(our_collections(scene)) == 1


def test_an_import_is_as_large_as_the_scenes_units_make_it_and_stays_whole(sphere_scan: Any) -> None:
    """A ball of half a metre in a scene of centimetres, whose unit is changed afterwards."""
    scene = bpy.context.scene
    scene.unit_settings.scale_length = 0.01
    collection = import_reconstruction(scene, sphere_scan.folder)
    (item,) = parts(collection, MESH_PART)
    np.testing.assert_allclose(_vertices(item), 100 * sphere_scan.mesh.vertices, rtol=1e-6, atol=1e-4)
    poses = {entry["frame"]: np.array(entry["world_from_camera"]) for entry in sphere_scan.record["trajectory"]}
    marker = next(item for item in collection.all_objects if item.get("query") == 8 and item.type == "CAMERA")
    np.testing.assert_allclose(marker.matrix_world.translation, 100 * poses[7][:3, 3], rtol=1e-6)
    scene.unit_settings.scale_length = 1.0  # Blender leaves all objects as they are
    bpy.ops.scanback.look_through(target="FRAME", frame=4)
    bpy.context.view_layer.update()
    np.testing.assert_allclose(scene.camera.matrix_world.translation, 100 * poses[4][:3, 3], rtol=1e-6)
    assert scene.camera.data.clip_end > 10 * np.linalg.norm(100 * poses[4][:3, 3])
    assert bpy.ops.scanback.import_dataset(directory=str(sphere_scan.dataset)) == {"FINISHED"}
    scene.frame_set(scene.frame_start + 4)
    np.testing.assert_allclose(scene.camera.matrix_world.translation, poses[4][:3, 3], atol=1e-5)
    import_reconstruction(scene, sphere_scan.folder)
    (item,) = parts(collection, MESH_PART)
    np.testing.assert_array_equal(_vertices(item), sphere_scan.mesh.vertices.astype(np.float32))
