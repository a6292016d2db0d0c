"""Saved files, dropped files, and what is left of the extension when it goes."""

import tempfile
import time
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest
import trimesh

import blender_addon
from blender_addon.files.mesh_arrays import mesh_arrays
from blender_addon.files.ply_mesh import ColoredMesh, read_colored_mesh, write_triangles
from blender_addon.preferences import SCANBACK_AP_preferences
from blender_addon.results.import_reconstruction import import_reconstruction
from blender_addon.results.live_mesh import LiveMesh, remove_live_meshes
from blender_addon.results.mesh_import import create_mesh_object, fill_mesh
from blender_addon.results.scene_collection import FOLDER_KEY, MESH_PART, parts
from blender_addon.scan_folder import scan_folder

HANDLERS = ("load_post", "save_pre", "save_post", "save_post_fail", "undo_post", "redo_post")


@pytest.mark.usefixtures("extension")
def test_a_saved_file_has_relative_paths_and_reopens_with_all_in_place(sphere_scan: Any, tmp_path: Path) -> None:
    import_reconstruction(bpy.context.scene, sphere_scan.folder)
    bpy.ops.scanback.look_through(target="FRAME", frame=4)
    bpy.context.scene.scanback.folder = str(tmp_path)
    (tmp_path / "blends").mkdir()
    first, copy, moved = (tmp_path / name for name in ("a.blend", "blends/copy.blend", "blends/b.blend"))
    bpy.ops.wm.save_as_mainfile(filepath=str(first))
    assert bpy.data.collections["Scanback sphere"][FOLDER_KEY] == "//sphere"
    bpy.ops.wm.save_as_mainfile(filepath=str(copy), copy=True)
    assert bpy.data.collections["Scanback sphere"][FOLDER_KEY] == "//sphere"
    bpy.ops.wm.save_as_mainfile(filepath=str(moved))
    for blend, up in ((first, "//"), (copy, "//../"), (moved, "//../")):
        bpy.ops.wm.open_mainfile(filepath=str(blend))
        collection = bpy.data.collections["Scanback sphere"]
        assert collection[FOLDER_KEY] == f"{up}sphere"
        assert Path(bpy.path.abspath(bpy.context.scene.scanback.folder)).resolve() == tmp_path
        assert bpy.context.scene.scanback.folder.startswith("//")
        (picture,) = bpy.data.objects["Frame 4"].data.background_images
        assert picture.image.filepath.startswith("//")
        assert Path(bpy.path.abspath(picture.image.filepath)).resolve().is_file()
        assert bpy.ops.scanback.step_view(step=1) == {"FINISHED"}
        assert bpy.ops.scanback.import_reconstruction(directory=str(sphere_scan.folder)) == {"FINISHED"}
        assert len([c for c in bpy.data.collections if FOLDER_KEY in c]) == 1


@pytest.mark.slow
@pytest.mark.usefixtures("extension")
def test_a_scan_stays_the_scenes_where_the_file_is_saved_or_renamed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder that an empty setting stands for goes with the file, the scan does not."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "cache"))
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_cube_add()
    assert bpy.ops.scanback.scan(frames=1, width=8, height=8, preset="draft") == {"FINISHED"}
    there = scan_folder(scene)
    assert there.is_relative_to(tmp_path / "cache")
    for name in ("one.blend", "two.blend"):
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / name))
        assert scan_folder(scene) == there
        assert (there / "dataset" / "dataset.json").is_file()
        assert scene.scanback.folder.startswith("//")


@pytest.mark.usefixtures("extension")
def test_a_mesh_file_is_imported_with_its_colors(sphere_scan: Any, tmp_path: Path) -> None:
    assert bpy.ops.scanback.import_ply(filepath=str(sphere_scan.folder / "mesh.ply")) == {"FINISHED"}
    item = bpy.context.view_layer.objects.active
    assert item.data.color_attributes.active_color.name == "Color"
    (tmp_path / "bad.ply").write_text("ply\nformat ascii 1.0\nend_header\n")
    with pytest.raises(RuntimeError, match=r"bad\.ply: its format is ascii.*export it anew"):
        bpy.ops.scanback.import_ply(filepath=str(tmp_path / "bad.ply"))


@pytest.mark.usefixtures("extension")
def test_a_dropped_file_stands_for_its_folder(sphere_scan: Any) -> None:
    for file, name in (
        (sphere_scan.folder / "reconstruction.json", "Scanback sphere"),
        (sphere_scan.dataset / "dataset.json", "Scanback dataset"),
    ):
        assert bpy.ops.scanback.import_dropped("INVOKE_DEFAULT", filepath=str(file)) == {"FINISHED"}
        assert name in bpy.data.collections
    with pytest.raises(RuntimeError, match=r"poses\.json: neither reconstruction\.json nor dataset\.json; drop one"):
        bpy.ops.scanback.import_dropped("INVOKE_DEFAULT", filepath=str(sphere_scan.folder / "poses.json"))


@pytest.mark.usefixtures("extension")
def test_each_kind_of_file_has_one_handler_that_blender_can_give_files_to() -> None:
    """Of two for one kind Blender asks which is meant; and it warns of a folder without files, or files without one."""
    handlers = [getattr(bpy.types, name) for name in dir(bpy.types) if name.startswith("SCANBACK_FH_")]
    assert sorted(handler.bl_file_extensions for handler in handlers) == [".json", ".ply"]
    for handler in handlers:
        module, _, name = handler.bl_import_operator.partition(".")
        properties = getattr(getattr(bpy.ops, module), name).get_rna_type().properties
        assert properties["filepath"].is_skip_save
        assert ("directory" in properties) == ("files" in properties)


@pytest.mark.usefixtures("extension")
def test_everything_has_a_tooltip_without_a_full_stop() -> None:
    operators = [getattr(bpy.ops.scanback, name).get_rna_type() for name in dir(bpy.ops.scanback)]
    assert len(operators) >= 15
    settings = bpy.context.scene.scanback
    groups = [getattr(settings, name).bl_rna for name in ("scan", "fuse", "locate", "compare")]
    preferences = {"cache_folder", "render_device", "fusion_device"}
    for name in preferences:
        assert SCANBACK_AP_preferences.bl_rna.properties[name].description
    for described in operators:
        assert described.description, described.identifier
        assert not described.description.endswith("."), described.identifier
    for owner in (*operators, *groups):
        for item in owner.properties:
            if item.identifier not in ("rna_type", "name") and not item.is_hidden:
                assert item.description, (owner.identifier, item.identifier)
                assert not item.description.endswith("."), (owner.identifier, item.identifier)


def test_nothing_is_left_of_the_extension(empty_scene: bpy.types.Scene) -> None:
    def inventory() -> dict[str, Any]:
        return {
            "types": {name for name in dir(bpy.types) if "scanback" in name.lower()},
            "handlers": {name: len(getattr(bpy.app.handlers, name)) for name in HANDLERS},
            "menu": len(bpy.types.TOPBAR_MT_file_import.draw._draw_funcs),
            "operators": dir(bpy.ops.scanback),
            "scene": hasattr(bpy.types.Scene, "scanback"),
        }

    before = inventory()
    assert not before["types"]
    for _ in range(2):
        blender_addon.register()
        assert inventory() != before
        blender_addon.unregister()
        assert inventory() == before


def test_a_million_vertices_come_in_pieces_that_do_not_hold_blender_up(empty_scene: bpy.types.Scene) -> None:
    """No piece takes the main thread more than 0.3 s of the processor, whatever else the machine does."""
    side = 1000
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), axis=-1).reshape(-1, 2)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + side], axis=1)
    upper = np.stack([corner + 1, corner + side + 1, corner + side], axis=1)
    mesh = ColoredMesh(
        vertices_world=np.column_stack([grid / side, np.sin(grid.sum(axis=1) / 50)]).astype(np.float32),
        triangles=np.concatenate([lower, upper]).astype(np.int32),
        colors_srgb=np.full((side * side, 4), 200, np.uint8),
    )
    arrays = mesh_arrays(mesh)
    pieces, name = fill_mesh("large", arrays), ""
    longest = 0.0
    while True:
        began = time.thread_time()
        found = next(pieces, None)
        longest = max(longest, time.thread_time() - began)
        if found is None:
            break
        name = found
    assert longest < 0.3
    data = bpy.data.meshes[name]
    assert len(data.vertices) - len(data.edges) + len(data.polygons) == 1  # Euler's number of a disc


def test_both_ways_to_make_a_mesh_make_the_same(empty_scene: bpy.types.Scene) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3)
    colors = np.random.default_rng(0).integers(0, 256, (len(sphere.vertices), 4), dtype=np.uint8)
    mesh = ColoredMesh(
        vertices_world=sphere.vertices.astype(np.float32), triangles=sphere.faces.astype(np.int32), colors_srgb=colors
    )
    at_once = create_mesh_object("a", mesh).data
    *_, name = fill_mesh("b", mesh_arrays(mesh))
    in_pieces = bpy.data.meshes[name]
    assert in_pieces.validate(verbose=False) is False
    assert [tuple(p.vertices) for p in at_once.polygons] == [tuple(p.vertices) for p in in_pieces.polygons]
    edges = [{frozenset(edge.vertices) for edge in data.edges} for data in (at_once, in_pieces)]
    assert edges[0] == edges[1]
    for data in (at_once, in_pieces):
        found = np.empty(4 * len(colors), np.float32)
        data.color_attributes["Color"].data.foreach_get("color_srgb", found)
        np.testing.assert_array_equal(np.rint(255 * found).astype(np.uint8), colors.ravel())


@pytest.mark.usefixtures("extension")
def test_the_growing_mesh_follows_its_file_and_the_older_result_stands_aside(sphere_scan: Any, tmp_path: Path) -> None:
    scene = bpy.context.scene
    collection = import_reconstruction(scene, sphere_scan.folder)
    (older,) = parts(collection, MESH_PART)
    live = LiveMesh(tmp_path / "live.ply", sphere_scan.folder, lambda: bpy.context.scene)

    def followed(vertices: int) -> bool:
        end = time.monotonic() + 20
        while time.monotonic() < end:
            live.follow()
            found = [item for item in scene.objects if item.get("scanback_part") == "live"]
            if found and len(found[0].data.vertices) == vertices:
                return True
            time.sleep(0.01)
        return False

    live.follow()  # no file yet
    for subdivisions in (1, 2):
        ball = trimesh.creation.icosphere(subdivisions=subdivisions)
        ball.visual.vertex_colors = np.full((len(ball.vertices), 4), 128, np.uint8)
        ball.export(tmp_path / "new.ply")
        (tmp_path / "new.ply").replace(tmp_path / "live.ply")
        assert followed(len(ball.vertices))
        assert older.hide_get()
    live.remove()
    assert not older.hide_get()
    assert not [item for item in scene.objects if item.get("scanback_part") == "live"]
    assert len(bpy.data.meshes) == 1
    remove_live_meshes()


def test_triangles_are_written_as_others_read_them(tmp_path: Path) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=2)
    write_triangles(tmp_path / "x.ply", sphere.vertices.astype(np.float32), sphere.faces.astype(np.int32))
    read = trimesh.load(tmp_path / "x.ply", process=False)
    np.testing.assert_array_equal(read.faces, sphere.faces)
    np.testing.assert_array_equal(read.vertices.astype(np.float32), sphere.vertices.astype(np.float32))
    with pytest.raises(ValueError, match="no colours"):
        read_colored_mesh(tmp_path / "x.ply")


@pytest.mark.usefixtures("extension")
def test_what_belongs_to_another_file_is_left_alone(sphere_scan: Any, tmp_path: Path) -> None:
    """A reconstruction that was linked, or overridden, stays; importing its folder makes one of this file's own."""
    import_reconstruction(bpy.context.scene, sphere_scan.folder)
    library = tmp_path / "library.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(library))
    for override in (False, True):
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        scene = bpy.context.scene
        with bpy.data.libraries.load(str(library), link=True) as (_, wanted):
            wanted.collections = ["Scanback sphere"]
        scene.collection.children.link(wanted.collections[0])
        if override:
            wanted.collections[0].override_hierarchy_create(scene, bpy.context.view_layer)
        before = {item.as_pointer() for item in scene.objects}
        assert len(before) >= 6
        with pytest.raises(RuntimeError, match="The scene has no reconstruction"):
            bpy.ops.scanback.replay()
        assert bpy.ops.scanback.import_reconstruction(directory=str(sphere_scan.folder)) == {"FINISHED"}
        assert before < {item.as_pointer() for item in scene.objects}
        assert bpy.ops.scanback.replay() == {"FINISHED"}
