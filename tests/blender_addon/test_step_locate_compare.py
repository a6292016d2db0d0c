"""Locate and compare, as the panel's buttons and as scripts do them."""

import json
from pathlib import Path

import bpy
import numpy as np
import pytest
from scanned_project import Project

from blender_addon.errors import ReconstructionError
from blender_addon.results.error_colors import ERROR_COLORS, ERROR_METRES, NUMBERS_KEY, put_errors
from blender_addon.results.originals import originals_of
from blender_addon.results.scene_collection import MESH_PART, our_collections, parts


def _collection() -> bpy.types.Collection:
    (collection,) = our_collections(bpy.context.scene)
    return collection


def test_a_frame_is_located_where_it_was_left_out(project: Project) -> None:
    assert bpy.ops.scanback.locate(folder=str(project.folder), query="FRAME", frame=3) == {"FINISHED"}
    cameras = [item for item in _collection().all_objects if item.type == "CAMERA" and "query" in item]
    assert [camera["query"] for camera in cameras] == [3]
    assert cameras[0]["nearest"] in (0, 2, 4, 6, 8)
    (background,) = cameras[0].data.background_images
    nearest = cameras[0]["nearest"]
    assert Path(bpy.path.abspath(background.image.filepath)).name == f"frame-{nearest:06d}.color.png"
    assert cameras[0].data.show_background_images
    assert tuple(background.image.size) == (64, 48)


def test_a_frame_that_is_not_there_is_told_in_plain_words(project: Project) -> None:
    with pytest.raises(RuntimeError, match="There is no frame 10; the dataset's are 0 to 9"):
        bpy.ops.scanback.locate(folder=str(project.folder), query="FRAME", frame=10)


@pytest.mark.slow
def test_image_files_are_located_as_the_frame_that_they_are_from(project: Project) -> None:
    frames = project.folder / "dataset" / "frames"
    metadata = json.loads((project.folder / "dataset" / "dataset.json").read_bytes())
    bpy.ops.scanback.locate(
        folder=str(project.folder),
        query="FILES",
        depth_file=str(frames / "frame-000004.depth.png"),
        color_file=str(frames / "frame-000004.color.png"),
        depth_scale=metadata["depth_scale"],
    )
    (camera,) = (item for item in _collection().all_objects if item.type == "CAMERA" and "query" in item)
    assert camera["nearest"] == 4


@pytest.mark.slow
def test_the_scenes_camera_is_located_where_it_stands(project: Project) -> None:
    bpy.ops.scanback.look_through(target="FRAME", frame=6)
    assert bpy.context.scene.camera.name == "Frame 6"
    assert bpy.ops.scanback.locate(folder=str(project.folder), query="CAMERA") == {"FINISHED"}
    (camera,) = (item for item in _collection().all_objects if item.type == "CAMERA" and "query" in item)
    assert camera["nearest"] == 6


def test_errors_are_colors_with_numbers(project: Project) -> None:
    collection = _collection()
    collection.name = "mine"  # names are the user's
    (item,) = parts(collection, MESH_PART)
    item.name = "renamed"
    settings = bpy.context.scene.scanback.compare
    settings.truth, settings.object_name = "OBJECT", "Original"
    original = settings.original
    original.name = "Renamed"
    assert bpy.ops.scanback.compare(folder=str(project.folder)) == {"FINISHED"}
    assert originals_of(bpy.context.scene, project.folder / "reconstruction") == [original]
    assert (item.visible_get(), original.visible_get()) == (True, False)
    data = item.data
    errors = np.empty(len(data.vertices), np.float32)
    data.attributes[ERROR_METRES].data.foreach_get("value", errors)
    numbers = item[NUMBERS_KEY]
    assert 0 < numbers["accuracy_m"] < project.unit * project.voxel / 2
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
def test_a_mesh_that_was_deleted_is_brought_back_to_be_compared(project: Project) -> None:
    (item,) = parts(_collection(), MESH_PART)
    bpy.data.objects.remove(item)
    bpy.ops.ed.undo_push(message="deleted")
    assert bpy.ops.scanback.compare(folder=str(project.folder)) == {"FINISHED"}
    (item,) = parts(_collection(), MESH_PART)
    assert ERROR_COLORS in item.data.attributes
    bpy.ops.ed.undo()
    assert not parts(_collection(), MESH_PART)  # bringing it back and colouring it are one step
    bpy.ops.ed.redo()


def test_a_mesh_that_was_edited_is_not_colored(project: Project) -> None:
    (item,) = parts(_collection(), MESH_PART)
    errors = np.zeros(len(item.data.vertices) + 1, np.float32)
    with pytest.raises(ReconstructionError, match="it was edited; import the reconstruction again"):
        put_errors(item, errors, limit_m=0.0, numbers={})
