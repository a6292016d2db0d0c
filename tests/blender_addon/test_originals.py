"""What was scanned and its reconstruction stand in one place: only one of both is seen, and both can be had."""

import json
from pathlib import Path
from typing import Any

import bpy
import pytest

from blender_addon.errors import ReconstructionError
from blender_addon.results.import_reconstruction import import_reconstruction
from blender_addon.results.live_mesh import LiveMesh, remove_live_meshes
from blender_addon.results.originals import note_originals, originals_of, show_sides
from blender_addon.results.scene_collection import LIVE_PART, MESH_PART, PART_KEY, parts
from blender_addon.settings import ScanProperties
from blender_addon.steps.compare import triangles_of
from blender_addon.steps.evaluation import evaluated_as_shown
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


def test_one_of_both_is_shown_and_each_choice_is_one_step_back(collection: bpy.types.Collection) -> None:
    _cube()
    note_originals(collection, ["Cube", "gone"])
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
    collection: bpy.types.Collection,
) -> None:
    area = next(area for area in bpy.context.window_manager.windows[0].screen.areas if area.type == "VIEW_3D")
    shading = area.spaces.active.shading
    assert (shading.type, shading.color_type, shading.light) == ("SOLID", "MATERIAL", "STUDIO")
    _cube()
    note_originals(collection, ["Cube"])
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
    note_originals(collection, ["Cube"])
    again = import_reconstruction(bpy.context.scene, sphere_scan.folder)
    assert originals_of(bpy.context.scene, again) == [cube]
    note_originals(again, ["Cube"])
    assert originals_of(bpy.context.scene, again) == [cube]


def test_without_originals_there_is_nothing_to_choose(collection: bpy.types.Collection) -> None:
    with pytest.raises(RuntimeError, match="What was scanned is not in this scene"):
        bpy.ops.scanback.show_side(side="ORIGINAL")
    collection["scanback_originals"] = "not ours"
    with pytest.raises(RuntimeError, match="What was scanned is not in this scene"):
        bpy.ops.scanback.show_side(side="ORIGINAL")
    note_originals(collection, ["Scanback mesh"])  # our own mesh is no original
    assert not originals_of(bpy.context.scene, collection)


def test_what_grows_pushes_aside_what_is_seen_and_gives_it_back(
    collection: bpy.types.Collection, sphere_scan: Any, tmp_path: Path
) -> None:
    """However it ends: also where the file was saved meanwhile, and the growing mesh is found in it."""
    scene = bpy.context.scene
    cube, closed = _cube(), _cube("Closed")
    closed.hide_set(True)
    originals = ["Cube", "Closed", "gone"]
    live = LiveMesh(sphere_scan.folder / "mesh.ply", sphere_scan.folder, lambda: scene, originals=originals)
    while not any(item.get(PART_KEY) == LIVE_PART for item in scene.objects):
        live.follow()
    (mesh,) = parts(collection, MESH_PART)
    assert [item.visible_get() for item in (cube, closed, mesh)] == [False, False, False]
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "meanwhile.blend"))
    live.remove()
    assert [item.visible_get() for item in (cube, closed, mesh)] == [True, False, True]
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "meanwhile.blend"))
    names = ("Cube", "Closed", "Scanback mesh")
    assert [bpy.data.objects[name].visible_get() for name in names] == [True, False, True]
    remove_live_meshes()


@pytest.mark.parametrize("hide", ["eye", "screen", "collection's eye", "collection's screen"])
def test_a_hidden_object_is_taken_as_its_modifiers_make_it(hide: str) -> None:
    """Blender evaluates nothing that no viewport shows: what is hidden must be shown for that."""
    scene = bpy.context.scene
    group = bpy.data.collections.new("Group")
    scene.collection.children.link(group)
    cube = _cube()
    group.objects.link(cube)
    scene.collection.objects.unlink(cube)
    cube.modifiers.new("Subdivision", "SUBSURF").levels = 1
    layer = bpy.context.view_layer.layer_collection.children["Group"]
    bpy.context.view_layer.update()
    if hide == "eye":
        cube.hide_set(True)
    else:
        owner = {"screen": cube, "collection's eye": layer, "collection's screen": group}[hide]
        owner.hide_viewport = True
    cube.location.x = 5
    bpy.context.view_layer.update()
    vertices, triangles = triangles_of(cube)
    assert len(triangles) == 2 * 4 * 6
    assert vertices[:, 0].mean() == pytest.approx(5, abs=1e-5)
    assert not cube.visible_get()
    with evaluated_as_shown([cube]):
        assert cube.visible_get()
    assert not cube.visible_get()


def test_an_object_that_the_view_layer_excludes_is_refused() -> None:
    group = bpy.data.collections.new("Group")
    bpy.context.scene.collection.children.link(group)
    cube = _cube()
    group.objects.link(cube)
    bpy.context.scene.collection.objects.unlink(cube)
    bpy.context.view_layer.layer_collection.children["Group"].exclude = True
    with pytest.raises(ReconstructionError, match="Cube is excluded from the view layer; include its collection"):
        triangles_of(cube)


def test_a_scan_begun_by_an_older_version_is_gone_on_with(tmp_path: Path) -> None:
    (tmp_path / "source").mkdir()
    order = {"preset": "draft", "sensor": "NONE", "frames": 3}
    (tmp_path / "source" / "scan.json").write_text(json.dumps(order))
    assert scanned_objects(tmp_path) == ()
