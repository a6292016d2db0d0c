"""Fuse, as the panel's button and as scripts do it; and what each step says where it cannot be done."""

import os
import signal
import time
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest
from scanned_project import Project

from blender_addon.files.ply_mesh import read_colored_mesh
from blender_addon.jobs import runner
from blender_addon.jobs.job import State
from blender_addon.results.scene_collection import LIVE_PART, MESH_PART, PART_KEY, our_collections, parts
from blender_addon.settings import FuseProperties, ScanProperties
from blender_addon.steps import reasons
from blender_addon.steps.fuse import fuse_work
from blender_addon.steps.scan_source import write_source
from blender_addon.steps.scene_reference import remember

pytestmark = pytest.mark.usefixtures("extension")


def _collection() -> bpy.types.Collection:
    (collection,) = our_collections(bpy.context.scene)
    return collection


def test_the_mesh_lies_on_the_object_whatever_its_units_and_modifiers(project: Project) -> None:
    mesh = read_colored_mesh(project.folder / "reconstruction" / "mesh.ply")
    (item,) = parts(_collection(), MESH_PART)
    assert np.array_equal(item.matrix_world, np.eye(4))
    points = np.empty((len(item.data.vertices), 3), np.float32)
    item.data.vertices.foreach_get("co", points.ravel())
    np.testing.assert_allclose(project.unit * points, mesh.vertices_world, rtol=1e-6)  # files are in metres
    offsets = project.offsets(points[::7])
    assert np.mean(offsets) < project.voxel / 2
    assert np.quantile(offsets, 0.9) < project.voxel


def test_the_mesh_grows_in_the_place_of_the_original_and_holds_nothing_up(project: Project) -> None:
    seen = project.seen
    assert seen["state"] == "done", (seen["message"], seen["log"])
    assert (seen["why not before"], seen["why not meanwhile"]) == (None, "Fuse is running")
    assert seen["shown before"]
    assert "integrate" in seen["stages"]
    assert not seen["flickered"]
    assert seen["longest"] < 0.05
    assert "the original is hidden" in seen["message"]
    original = bpy.data.objects["Original"]
    assert not original.visible_get()
    assert original.hide_render
    assert not any(item.get(PART_KEY) == LIVE_PART for item in bpy.data.objects)
    assert not any("live" in mesh.name for mesh in bpy.data.meshes)


@pytest.mark.slow
def test_a_fuse_that_is_killed_leaves_the_older_result_in_its_place(project: Project) -> None:
    def files() -> dict[str, int]:
        return {path.name: path.stat().st_mtime_ns for path in (project.folder / "reconstruction").iterdir()}

    before, shown = files(), [item.name for item in bpy.data.objects if item.visible_get()]
    settings = bpy.context.scene.scanback.fuse
    chosen = {name: getattr(settings, name) for name in FuseProperties.__annotations__}
    job = runner.start(
        "Fuse", fuse_work(remember(bpy.context.scene), project.folder, project.folder / "dataset", chosen)
    )
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


def test_a_reconstruction_in_the_scene_is_not_scanned_with_it(project: Project, tmp_path: Path) -> None:
    settings = {name: getattr(bpy.context.scene.scanback.scan, name) for name in ScanProperties.__annotations__}
    write_source(bpy.context.scene, None, tmp_path, settings)
    with bpy.data.libraries.load(str(tmp_path / "scene.blend"), link=False) as (there, wanted):
        wanted.objects = there.objects
    meshes = {item.get(PART_KEY, item.name): item for item in wanted.objects if item.type == "MESH"}
    assert meshes.pop("mesh").hide_render
    assert not any(item.hide_render for item in meshes.values())  # although it stands aside for the mesh
    assert len(meshes) == 1
    bpy.data.batch_remove(wanted.objects)
    assert not any(item.hide_render for item in _collection().all_objects)


def test_fusing_again_replaces_and_is_one_step_back(project: Project) -> None:
    (before,) = parts(_collection(), MESH_PART)
    many = len(before.data.vertices)
    bpy.ops.scanback.show_side(side="ORIGINAL")
    bpy.data.objects["Original"].name = "Renamed"
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.scanback.fuse(folder=str(project.folder), voxel_size=2 * project.voxel, every=2, device="cpu", live=False)
    (after,) = parts(_collection(), MESH_PART)
    few = len(after.data.vertices)
    assert few < 0.5 * many
    assert len(our_collections(bpy.context.scene)) == 1
    assert (after.visible_get(), bpy.data.objects["Renamed"].visible_get()) == (True, False)
    bpy.ops.ed.undo()
    assert bpy.data.objects["Renamed"].visible_get()
    (item,) = parts(_collection(), MESH_PART)
    assert len(item.data.vertices) == many
    bpy.ops.ed.redo()
    (item,) = parts(_collection(), MESH_PART)
    assert len(item.data.vertices) == few


def test_what_is_not_there_is_told_and_harms_nothing(tmp_path: Path) -> None:
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
