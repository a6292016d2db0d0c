"""What was scanned and its reconstruction stand in one place: only one of both is seen, and both can be had."""

import json
from pathlib import Path
from typing import Any

import bpy
import pytest

from blender_addon.results.import_reconstruction import import_reconstruction
from blender_addon.results.live_mesh import LiveMesh, remove_live_meshes
from blender_addon.results.originals import note_originals, originals_of, show_sides
from blender_addon.results.scene_collection import LIVE_PART, MESH_PART, PART_KEY, parts
from blender_addon.settings import ScanProperties
from blender_addon.steps.scan import prepare_scan, scanned_objects

pytestmark = pytest.mark.usefixtures("extension")


def _cube(name: str = "Cube") -> bpy.types.Object:
    bpy.ops.mesh.primitive_cube_add()
    item = bpy.context.object
    item.name = name
    return item


@pytest.fixture
def collection(extension: None, sphere_scan: Any) -> bpy.types.Collection:
    return import_reconstruction(bpy.context.scene, sphere_scan.folder)


def _note(scan: Any, *names: str) -> None:
    note_originals(bpy.context.scene, scan.folder, [bpy.data.objects[name] for name in names])


def _shown(collection: bpy.types.Collection) -> tuple[bool, bool]:
    (mesh,) = parts(collection, MESH_PART)
    return bpy.data.objects["Cube"].visible_get(), mesh.visible_get()


def test_a_scan_notes_what_was_scanned(tmp_path: Path) -> None:
    cube, hidden = _cube(), _cube("Hidden")
    hidden.hide_render = True
    bpy.ops.object.light_add()
    child = _cube("Child")
    child.parent = cube
    _cube("Other")
    settings = {name: getattr(bpy.context.scene.scanback.scan, name) for name in ScanProperties.__annotations__}
    prepare_scan(bpy.context.scene, cube, tmp_path / "all", settings, overwrite=False)
    assert set(scanned_objects(tmp_path / "all")) == {"Cube", "Child", "Other"}
    prepare_scan(bpy.context.scene, cube, tmp_path / "one", settings | {"subject": "OBJECT"}, overwrite=False)
    assert set(scanned_objects(tmp_path / "one")) == {"Cube", "Child"}
    assert scanned_objects(tmp_path / "none") == ()


def test_one_of_both_is_shown_and_each_choice_is_one_step_back(
    collection: bpy.types.Collection, sphere_scan: Any
) -> None:
    _cube()
    _note(sphere_scan, "Cube")
    show_sides(bpy.context.scene, collection, original=False, reconstruction=True)
    bpy.ops.ed.undo_push(message="fused")
    name = collection.name
    for side, expected in (("ORIGINAL", (True, False)), ("BOTH", (True, True)), ("RECONSTRUCTION", (False, True))):
        assert bpy.ops.scanback.show_side(side=side) == {"FINISHED"}
        assert _shown(bpy.data.collections[name]) == expected
        bpy.ops.ed.undo_push(message=side)
    for expected in ((True, True), (True, False), (False, True)):
        bpy.ops.ed.undo()
        assert _shown(bpy.data.collections[name]) == expected
    bpy.ops.ed.redo()
    assert _shown(bpy.data.collections[name]) == (True, False)


def test_viewports_show_vertex_colors_as_they_are_where_nothing_else_is_seen(
    collection: bpy.types.Collection, sphere_scan: Any
) -> None:
    area = next(area for area in bpy.context.window_manager.windows[0].screen.areas if area.type == "VIEW_3D")
    shading = area.spaces.active.shading
    assert (shading.type, shading.color_type, shading.light) == ("SOLID", "MATERIAL", "STUDIO")
    _cube()
    _note(sphere_scan, "Cube")
    for side, expected in (
        ("RECONSTRUCTION", ("VERTEX", "FLAT")),
        ("BOTH", ("VERTEX", "STUDIO")),
        ("ORIGINAL", ("MATERIAL", "STUDIO")),
        ("RECONSTRUCTION", ("VERTEX", "FLAT")),
    ):
        bpy.ops.scanback.show_side(side=side)
        assert (shading.color_type, shading.light) == expected
    shading.color_type, shading.light = "RANDOM", "MATCAP"
    for side in ("ORIGINAL", "RECONSTRUCTION"):  # what the user chose stays
        bpy.ops.scanback.show_side(side=side)
        assert (shading.color_type, shading.light) == ("RANDOM", "MATCAP")


def test_importing_again_keeps_who_the_originals_are(collection: bpy.types.Collection, sphere_scan: Any) -> None:
    cube = _cube()
    for _ in range(2):
        _note(sphere_scan, "Cube")
        assert bpy.ops.scanback.import_reconstruction(directory=str(sphere_scan.folder)) == {"FINISHED"}
        assert originals_of(bpy.context.scene, sphere_scan.folder) == [cube]
        assert _shown(collection) == (False, True)


def test_without_originals_there_is_nothing_to_choose(collection: bpy.types.Collection, sphere_scan: Any) -> None:
    with pytest.raises(RuntimeError, match="What was scanned is not in this scene"):
        bpy.ops.scanback.show_side(side="ORIGINAL")
    _note(sphere_scan, "Scanback mesh")  # our own mesh is no original
    assert not originals_of(bpy.context.scene, sphere_scan.folder)


def test_what_grows_pushes_aside_what_is_seen_and_gives_it_back(
    collection: bpy.types.Collection, sphere_scan: Any, tmp_path: Path
) -> None:
    """However it ends: also where the file was saved meanwhile, and the growing mesh is found in it."""
    scene = bpy.context.scene
    cube, closed = _cube(), _cube("Closed")
    closed.hide_set(True)
    _note(sphere_scan, "Cube", "Closed")
    live = LiveMesh(sphere_scan.folder / "mesh.ply", sphere_scan.folder, lambda: scene)
    while not any(item.get(PART_KEY) == LIVE_PART for item in scene.objects):
        live.follow()
    (mesh,) = parts(collection, MESH_PART)
    assert [item.visible_get() for item in (cube, closed, mesh)] == [False, False, False]
    assert [item.hide_render for item in (cube, closed, mesh)] == [True, True, True]
    cube.name = "Renamed"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "meanwhile.blend"))
    live.remove()
    assert [item.visible_get() for item in (cube, closed, mesh)] == [True, False, True]
    assert not any(item.hide_render for item in (cube, closed, mesh))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "meanwhile.blend"))
    there = [bpy.data.objects[name] for name in ("Renamed", "Closed", "Scanback mesh")]
    assert [item.visible_get() for item in there] == [True, False, True]
    assert not any(item.hide_render for item in there)
    remove_live_meshes()


def test_a_scan_begun_by_an_older_version_is_gone_on_with(tmp_path: Path) -> None:
    (tmp_path / "source").mkdir()
    order = {"preset": "draft", "sensor": "NONE", "frames": 3}
    (tmp_path / "source" / "scan.json").write_text(json.dumps(order))
    assert scanned_objects(tmp_path) == ()


def test_who_the_originals_are_outlives_names_undo_and_the_file(
    collection: bpy.types.Collection, sphere_scan: Any, tmp_path: Path
) -> None:
    _cube("First")
    _cube("Second")
    bpy.ops.ed.undo_push(message="before")
    _note(sphere_scan, "First", "Second")
    bpy.ops.ed.undo_push(message="scanned")
    bpy.data.objects["First"].name = "Renamed"
    bpy.ops.ed.undo_push(message="renamed")

    def names() -> list[str]:
        return sorted(item.name for item in originals_of(bpy.context.scene, sphere_scan.folder))

    assert names() == ["Renamed", "Second"]
    bpy.ops.ed.undo()
    assert names() == ["First", "Second"]
    bpy.ops.ed.undo()
    assert names() == []  # before they were scanned
    bpy.ops.ed.redo()
    bpy.ops.ed.redo()
    assert names() == ["Renamed", "Second"]
    (tmp_path / "elsewhere").mkdir()
    for name in ("a.blend", "elsewhere/b.blend"):
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / name))
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / name))
        assert names() == ["Renamed", "Second"]
        assert bpy.context.scene.scanback.originals[0].folder.startswith("//")
    bpy.context.scene.scanback.originals.clear()
    _note(sphere_scan, "Renamed", "Second")  # as a scan in a saved file does
    assert names() == ["Renamed", "Second"]
    bpy.data.objects["Second"].name = "Other"
    bpy.data.objects["Renamed"].name = "Second"
    assert names() == ["Other", "Second"]
    assert bpy.ops.scanback.show_side(side="RECONSTRUCTION") == {"FINISHED"}
    assert not any(bpy.data.objects[name].visible_get() for name in names())


def test_an_original_that_was_deleted_is_gone_and_comes_back_with_an_undo(
    collection: bpy.types.Collection, sphere_scan: Any, tmp_path: Path
) -> None:
    """What is kept of it does not keep it in the file."""
    cube = _cube()
    scene = bpy.context.scene
    _note(sphere_scan, "Cube")
    scene.scanback.compare.original = cube
    bpy.ops.ed.undo_push(message="before")
    with bpy.context.temp_override(selected_objects=[cube]):
        bpy.ops.object.delete()
    bpy.ops.ed.undo_push(message="deleted")
    assert not originals_of(scene, sphere_scan.folder)
    with pytest.raises(RuntimeError, match="What was scanned is not in this scene"):
        bpy.ops.scanback.show_side(side="ORIGINAL")
    bpy.ops.ed.undo()
    assert [item.name for item in originals_of(bpy.context.scene, sphere_scan.folder)] == ["Cube"]
    bpy.ops.ed.redo()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    assert "Cube" not in bpy.data.objects
    assert not bpy.context.scene.scanback.originals
    assert bpy.context.scene.scanback.compare.object_name == ""


def test_a_new_scan_lets_go_of_what_was_scanned_before(collection: bpy.types.Collection, sphere_scan: Any) -> None:
    first, second = _cube("First"), _cube("Second")
    scene = bpy.context.scene
    _note(sphere_scan, "First")
    show_sides(scene, collection, original=False, reconstruction=True)
    assert not first.visible_get()
    assert first.hide_render
    note_originals(scene, sphere_scan.folder, [second], anew=True)
    assert originals_of(scene, sphere_scan.folder) == [second]
    assert first.visible_get()
    assert not first.hide_render
