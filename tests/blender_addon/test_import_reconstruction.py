import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from blender_addon.errors import ReconstructionError
from blender_addon.results.import_reconstruction import LOCATED_COLLECTION, import_reconstruction
from blender_addon.results.scene_collection import remove_parts
from datagen.rigid import inverse, transform_points

KINDS = ("objects", "meshes", "curves", "cameras", "materials", "collections")


def _inventory() -> dict[str, list[str]]:
    return {kind: sorted(block.name for block in getattr(bpy.data, kind)) for kind in KINDS}


def _markers(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    return [item for item in collection.children[LOCATED_COLLECTION].objects if item.type == "CAMERA"]


def test_everything_lies_in_a_collection_of_its_own(empty_scene: bpy.types.Scene, sphere_scan: Any) -> None:
    collection = import_reconstruction(empty_scene, sphere_scan.folder)
    assert collection.name == "Scanback sphere"
    assert list(empty_scene.collection.children) == [collection]
    assert not empty_scene.collection.objects
    assert sorted(item.type for item in collection.objects) == ["CURVE", "MESH"]
    assert len(collection.children[LOCATED_COLLECTION].objects) == 4


def test_the_path_goes_through_the_fused_poses(empty_scene: bpy.types.Scene, sphere_scan: Any) -> None:
    collection = import_reconstruction(empty_scene, sphere_scan.folder)
    (path,) = (item for item in collection.objects if item.type == "CURVE")
    (spline,) = path.data.splines
    expected = [np.array(item["world_from_camera"])[:3, 3] for item in sphere_scan.record["trajectory"]]
    np.testing.assert_allclose([point.co[:3] for point in spline.points], expected, atol=1e-6)
    assert np.array_equal(path.matrix_world, np.eye(4))
    # A line in viewports, where a camera on it sees freely; a tube in renders.
    assert not path.modifiers[0].show_viewport
    assert path.modifiers[0].show_render
    path.modifiers[0].show_viewport = True
    shown = path.evaluated_get(bpy.context.evaluated_depsgraph_get())
    tube = bpy.data.meshes.new_from_object(shown)
    vertices = np.array([vertex.co for vertex in tube.vertices])
    distances = np.linalg.norm(vertices[:, None] - np.array(expected)[None], axis=2).min(axis=1)
    assert np.ptp(distances) < 0.5 * distances.mean()
    assert 0 < distances.mean() < 0.02
    assert [material.name for material in tube.materials] == ["Scanback camera path"]
    bpy.data.meshes.remove(tube)
    again = import_reconstruction(empty_scene, sphere_scan.folder)
    assert len(bpy.data.node_groups) == 1
    remove_parts(again)
    assert not bpy.data.node_groups
    assert not bpy.data.materials


def test_a_marker_sees_the_world_as_the_frame_did(empty_scene: bpy.types.Scene, sphere_scan: Any) -> None:
    collection = import_reconstruction(empty_scene, sphere_scan.folder)
    bpy.context.view_layer.update()
    render = empty_scene.render
    points_world = np.asarray(sphere_scan.mesh.vertices[::97])
    for marker, pose in zip(_markers(collection), sphere_scan.poses, strict=True):
        clip_from_camera = marker.calc_matrix_camera(
            bpy.context.evaluated_depsgraph_get(),
            x=render.resolution_x,
            y=render.resolution_y,
            scale_x=render.pixel_aspect_x,
            scale_y=render.pixel_aspect_y,
        )
        clip_from_world = np.array(clip_from_camera) @ np.linalg.inv(np.array(marker.matrix_world))
        clip = np.column_stack([points_world, np.ones(len(points_world))]) @ clip_from_world.T
        x, y = (clip[:, :2] / clip[:, 3:]).T
        camera = sphere_scan.camera
        found_px = np.column_stack([(x + 1) / 2 * camera.width, (1 - y) / 2 * camera.height]) - 0.5
        expected_px = camera.project(transform_points(inverse(np.array(pose["world_from_camera"])), points_world))
        assert np.abs(found_px - expected_px).max() < 0.01


def test_a_marker_tells_what_it_marks(empty_scene: bpy.types.Scene, sphere_scan: Any) -> None:
    first, second = _markers(import_reconstruction(empty_scene, sphere_scan.folder))
    assert (first.name, second.name) == ("Query 5 nearest 4", "Query 8 nearest 7")
    assert (first["query"], first["nearest"], first["score"]) == (5, 4, 0.002)
    assert (first["rotation_error_deg"], first["translation_error_m"]) == (20.5, 0.25)
    assert "rotation_error_deg" not in second
    (frustum,) = first.children
    assert frustum.data == second.children[0].data  # one shape for all


def test_without_located_frames_there_is_no_sub_collection(empty_scene: bpy.types.Scene, sphere_scan: Any) -> None:
    (sphere_scan.folder / "poses.json").unlink()
    assert not import_reconstruction(empty_scene, sphere_scan.folder).children


def test_importing_again_replaces(empty_scene: bpy.types.Scene, sphere_scan: Any) -> None:
    first = import_reconstruction(empty_scene, sphere_scan.folder)
    before = _inventory()
    again = import_reconstruction(empty_scene, sphere_scan.folder / ".")
    assert again == first
    assert _inventory() == before


def test_importing_again_replaces_what_was_renamed_and_keeps_what_the_user_added(
    empty_scene: bpy.types.Scene, sphere_scan: Any
) -> None:
    collection = import_reconstruction(empty_scene, sphere_scan.folder)
    before = _inventory()
    collection.name = "mine"
    collection.objects[0].name = "renamed"
    added = [bpy.data.objects.new(name, None) for name in ("lamp", "note")]
    collection.objects.link(added[0])
    collection.children[LOCATED_COLLECTION].objects.link(added[1])
    bpy.data.cameras.remove(_markers(collection)[0].data)  # and the object with it
    assert import_reconstruction(empty_scene, sphere_scan.folder).name == "mine"
    assert {"lamp", "note"} <= set(collection.all_objects.keys())
    for item in added:
        bpy.data.objects.remove(item)
    collection.name = "Scanback sphere"
    assert _inventory() == before


def test_importing_again_takes_away_markers_that_are_gone(empty_scene: bpy.types.Scene, sphere_scan: Any) -> None:
    import_reconstruction(empty_scene, sphere_scan.folder)
    (sphere_scan.folder / "poses.json").unlink()
    import_reconstruction(empty_scene, sphere_scan.folder)
    assert not bpy.data.cameras
    assert len(bpy.data.materials) == 2


def test_a_second_reconstruction_of_the_same_name_stands_beside_the_first(
    empty_scene: bpy.types.Scene, sphere_scan: Any, tmp_path: Path
) -> None:
    import_reconstruction(empty_scene, sphere_scan.folder)
    other = tmp_path / "other" / "sphere"
    other.parent.mkdir()
    sphere_scan.folder.rename(other)
    assert import_reconstruction(empty_scene, other).name == "Scanback sphere.001"
    assert len(empty_scene.collection.children) == 2


def test_a_collection_deleted_from_the_scene_is_made_again(empty_scene: bpy.types.Scene, sphere_scan: Any) -> None:
    collection = import_reconstruction(empty_scene, sphere_scan.folder)
    empty_scene.collection.children.unlink(collection)
    import_reconstruction(empty_scene, sphere_scan.folder)
    assert [child.name for child in empty_scene.collection.children] == ["Scanback sphere"]


def test_another_scene_keeps_its_own_import(empty_scene: bpy.types.Scene, sphere_scan: Any) -> None:
    first = import_reconstruction(empty_scene, sphere_scan.folder)
    second = import_reconstruction(bpy.data.scenes.new("second"), sphere_scan.folder)
    assert first != second
    assert len(first.all_objects) == len(second.all_objects) == 6


def test_the_render_size_is_left_alone_when_asked(empty_scene: bpy.types.Scene, sphere_scan: Any) -> None:
    empty_scene.render.resolution_x = 777
    import_reconstruction(empty_scene, sphere_scan.folder, match_render_size=False)
    assert empty_scene.render.resolution_x == 777
    import_reconstruction(empty_scene, sphere_scan.folder)
    assert (empty_scene.render.resolution_x, empty_scene.render.resolution_y) == (160, 120)


@pytest.mark.parametrize(
    "damage",
    [
        lambda folder: (folder / "mesh.ply").unlink(),
        lambda folder: (folder / "mesh.ply").write_bytes(b"ply\n"),
        lambda folder: (folder / "reconstruction.json").unlink(),
        lambda folder: (folder / "reconstruction.json").write_text("{"),
        lambda folder: (folder / "poses.json").write_text('[{"query": 1}]'),
    ],
)
def test_bad_input_leaves_the_scene_as_it_was(
    empty_scene: bpy.types.Scene, sphere_scan: Any, damage: Callable[[Path], Any]
) -> None:
    import_reconstruction(empty_scene, sphere_scan.folder)
    objects, before = set(bpy.data.objects), _inventory()
    damage(sphere_scan.folder)
    with pytest.raises(ReconstructionError, match=str(sphere_scan.folder)):
        import_reconstruction(empty_scene, sphere_scan.folder)
    assert set(bpy.data.objects) == objects
    assert _inventory() == before


def test_a_thousand_poses_are_imported_within_a_second(empty_scene: bpy.types.Scene, sphere_scan: Any) -> None:
    trajectory = sphere_scan.record["trajectory"]
    sphere_scan.record["trajectory"] = [trajectory[i % len(trajectory)] for i in range(1000)]
    sphere_scan.rewrite()
    start = time.perf_counter()
    import_reconstruction(empty_scene, sphere_scan.folder)
    assert time.perf_counter() - start < 1.0
    assert len(bpy.data.objects) == 6
