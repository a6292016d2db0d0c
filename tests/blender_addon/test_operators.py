from typing import Any

import bpy
import pytest

import blender_addon


@pytest.mark.usefixtures("extension")
def test_the_operator_imports_into_the_scene(sphere_scan: Any) -> None:
    result = bpy.ops.scanback.import_reconstruction(directory=f"{sphere_scan.folder}/")
    assert result == {"FINISHED"}
    assert "Scanback sphere" in bpy.context.scene.collection.children


@pytest.mark.usefixtures("extension")
def test_the_operator_asks_blender_for_an_undo_step() -> None:
    assert {"REGISTER", "UNDO"} <= set(bpy.types.SCANBACK_OT_import_reconstruction.bl_options)


@pytest.mark.usefixtures("extension")
def test_the_operator_reports_bad_input_in_plain_words(sphere_scan: Any) -> None:
    (sphere_scan.folder / "mesh.ply").unlink()
    with pytest.raises(RuntimeError, match=r"Error: .*mesh\.ply: the file is missing; write it again"):
        bpy.ops.scanback.import_reconstruction(directory=str(sphere_scan.folder))
    with pytest.raises(RuntimeError, match="Error: No folder chosen"):
        bpy.ops.scanback.import_reconstruction()
    assert not bpy.data.objects


@pytest.mark.usefixtures("extension")
def test_everything_the_user_can_touch_has_a_tooltip() -> None:
    operator = bpy.ops.scanback.import_reconstruction.get_rna_type()
    assert operator.description
    for name in ("directory", "match_render_size"):
        assert operator.properties[name].description
    assert not operator.description.endswith(".")  # Blender adds it


def test_unregistering_leaves_nothing(empty_scene: bpy.types.Scene) -> None:
    entries = len(bpy.types.TOPBAR_MT_file_import.draw._draw_funcs)
    blender_addon.register()
    assert len(bpy.types.TOPBAR_MT_file_import.draw._draw_funcs) == entries + 1
    blender_addon.unregister()
    assert len(bpy.types.TOPBAR_MT_file_import.draw._draw_funcs) == entries
    assert not hasattr(bpy.types, "SCANBACK_OT_import_reconstruction")
    assert not hasattr(bpy.types, "SCANBACK_PT_reconstruction")
