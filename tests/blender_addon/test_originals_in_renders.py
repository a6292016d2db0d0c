"""Renders show what the viewport does of what was scanned and its reconstruction."""

from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from blender_addon.results.import_reconstruction import import_reconstruction
from blender_addon.results.originals import keep_from_renders, note_originals, show_sides
from blender_addon.results.scene_collection import MESH_PART, PART_KEY, parts
from blender_addon.settings import ScanProperties
from blender_addon.steps import reasons
from blender_addon.steps.scan_source import write_source

pytestmark = pytest.mark.usefixtures("extension")


@pytest.fixture
def original(extension: None, sphere_scan: Any) -> bpy.types.Object:
    """A block that stands through the ball that was made of it, before a camera, in a scene that is not lit."""
    scene = bpy.context.scene
    import_reconstruction(scene, sphere_scan.folder)
    bpy.ops.mesh.primitive_cube_add(size=0.8, location=(0.1, -0.2, 0.3))
    block = bpy.context.object
    block.name = "Block"
    bpy.ops.object.camera_add(location=(0.1, -4, 0.3), rotation=(np.pi / 2, 0, 0))
    scene.camera = bpy.context.object
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", 1
    scene.cycles.use_denoising = False
    scene.render.resolution_x, scene.render.resolution_y, scene.render.film_transparent = 24, 18, True
    scene.view_settings.view_transform = "Standard"
    scene.render.dither_intensity = 0.0
    note_originals(scene, sphere_scan.folder, [block])
    return block


def _render(path: Path) -> np.ndarray:
    """Return what a press of F12 shows (height, width, 4)."""
    bpy.ops.render.render()
    bpy.data.images["Render Result"].save_render(str(path))
    image = bpy.data.images.load(str(path))
    pixels = np.array(image.pixels[:]).reshape(18, 24, 4)
    bpy.data.images.remove(image)
    return pixels


def test_renders_show_the_side_that_the_viewport_shows(original: bpy.types.Object, tmp_path: Path) -> None:
    seen = {}
    for side in ("ORIGINAL", "BOTH", "RECONSTRUCTION"):
        assert bpy.ops.scanback.show_side(side=side) == {"FINISHED"}
        seen[side] = _render(tmp_path / f"{side}.png")
    ball = next(item for item in bpy.data.objects if item.get(PART_KEY) == MESH_PART)
    bpy.ops.scanback.show_side(side="BOTH")
    place = ball.location.copy()
    for away, side in ((ball, "ORIGINAL"), (original, "RECONSTRUCTION")):
        place = away.location.copy()
        away.location.z = 1000
        np.testing.assert_array_equal(_render(tmp_path / "alone.png"), seen[side])
        away.location = place
    assert (seen["ORIGINAL"][..., 3] > 0).sum() > 20
    assert not np.array_equal(seen["ORIGINAL"], seen["RECONSTRUCTION"])
    assert not np.array_equal(seen["BOTH"], seen["RECONSTRUCTION"])


def test_what_does_not_render_by_the_users_choice_never_does(original: bpy.types.Object) -> None:
    original.hide_render = True
    for side in ("RECONSTRUCTION", "ORIGINAL", "BOTH"):
        bpy.ops.scanback.show_side(side=side)
        assert original.hide_render
    original.hide_render = False
    bpy.ops.scanback.show_side(side="RECONSTRUCTION")
    assert original.hide_render
    bpy.ops.scanback.show_side(side="ORIGINAL")
    assert not original.hide_render


def test_choices_are_saved_and_undone_with_all_else(original: bpy.types.Object, tmp_path: Path) -> None:
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.scanback.show_side("EXEC_DEFAULT", True, side="RECONSTRUCTION")
    bpy.ops.ed.undo()
    assert not bpy.data.objects["Block"].hide_render
    bpy.ops.ed.redo()
    assert bpy.data.objects["Block"].hide_render
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    assert bpy.data.objects["Block"].hide_render
    bpy.ops.scanback.show_side(side="ORIGINAL")
    assert not bpy.data.objects["Block"].hide_render


def test_what_stands_aside_is_scanned_again_as_it_was(original: bpy.types.Object, tmp_path: Path) -> None:
    bpy.ops.scanback.show_side(side="RECONSTRUCTION")
    scene = bpy.context.scene
    bpy.context.view_layer.objects.active = original
    for subject in ("SCENE", "OBJECT"):
        scene.scanback.scan.subject = subject
        assert reasons.why_not_scan(bpy.context) is None
        settings = {name: getattr(scene.scanback.scan, name) for name in ScanProperties.__annotations__}
        write_source(scene, original, tmp_path / subject, settings)
        with bpy.data.libraries.load(str(tmp_path / subject / "scene.blend"), link=False) as (there, wanted):
            wanted.objects = there.objects
        renders = {
            item.get(PART_KEY, "original"): not item.hide_render for item in wanted.objects if item.type == "MESH"
        }
        assert renders == ({"original": True, "mesh": False} if subject == "SCENE" else {"original": True})
        bpy.data.batch_remove(wanted.objects)
    assert original.hide_render
    assert not original.visible_get()


def test_an_object_of_several_scenes_goes_on_to_render(original: bpy.types.Object, sphere_scan: Any) -> None:
    """Blender cannot keep it from one scene's renders alone, and the other scene has nothing in its place."""
    other = bpy.data.scenes.new("Other")
    other.collection.objects.link(original)
    bpy.ops.scanback.show_side(side="RECONSTRUCTION")
    assert not original.visible_get()
    assert not original.hide_render
    bpy.data.scenes.remove(other)
    bpy.ops.scanback.show_side(side="RECONSTRUCTION")
    assert original.hide_render


def test_two_reconstructions_of_one_object_give_it_back_once(original: bpy.types.Object, tmp_path: Path) -> None:
    scene = bpy.context.scene
    note_originals(scene, tmp_path / "second", [original])
    for kept in (True, True, False):
        keep_from_renders(scene, [original], kept=kept)
        assert original.hide_render == kept
    assert not any(entry.is_kept_from_renders for entry in scene.scanback.originals)


def test_objects_of_another_file_stand_aside_also_when_the_file_is_opened_again(
    original: bpy.types.Object, sphere_scan: Any, tmp_path: Path
) -> None:
    """Blender does not save what renders of another file's objects."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    for override in (False, True):
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        scene = bpy.context.scene
        with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, wanted):
            wanted.objects = ["Block"]
        (block,) = wanted.objects
        scene.collection.objects.link(block)
        if override:
            block = block.override_create(remap_local_usages=True)
        note_originals(scene, sphere_scan.folder, [block])
        collection = import_reconstruction(scene, sphere_scan.folder)
        show_sides(scene, collection, original=False, reconstruction=True)
        assert block.hide_render
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "user.blend"))
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "user.blend"))
        (block,) = (item for item in bpy.context.scene.objects if item.name == "Block")
        assert (block.library is None) == override
        assert block.hide_render
        assert not block.visible_get()
        (ball,) = parts(bpy.data.collections["Scanback sphere"], MESH_PART)
        assert not ball.hide_render
        bpy.ops.scanback.show_side(side="ORIGINAL")
        assert not block.hide_render
        assert ball.hide_render
