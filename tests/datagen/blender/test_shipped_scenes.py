"""The scenes that come along: closed surfaces in their places, and a camera that sees them from every side."""

import numpy as np
import pytest
import trimesh

from datagen.scene_spec.scene_files import load_scene, with_render_settings

TABLE_TOP = 0.75
NOT_ON_THE_TABLE = {"Floor", "Parapet", "Pot", "Table"}


@pytest.fixture
def shipped(open_session):
    return lambda name: open_session(with_render_settings(load_scene(name), size=(16, 12), samples=1))


def meshes_by_object(session):
    """The evaluated meshes of each object's parts, world coordinates."""
    import bpy

    names = [settings.name for settings in session.spec.objects]
    found = {name: [] for name in names}
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        if instance.object.type == "MESH":
            mesh = instance.object.to_mesh()
            mesh.calc_loop_triangles()
            points, triangles = np.empty((len(mesh.vertices), 3)), np.empty((len(mesh.loop_triangles), 3), int)
            mesh.vertices.foreach_get("co", points.reshape(-1))
            mesh.loop_triangles.foreach_get("vertices", triangles.reshape(-1))
            points = trimesh.transform_points(points, np.array(instance.matrix_world))
            found[names[instance.object.pass_index - 1]].append(trimesh.Trimesh(points, triangles, process=False))
            instance.object.to_mesh_clear()
    return found


@pytest.fixture(scope="module")
def kept():
    """Meshes by object, once a test has made them."""
    return {}


@pytest.fixture
def on_the_table(shipped, kept):
    if not kept:
        kept.update(meshes_by_object(shipped("table")))
    return kept


def directions_seen_from(session, center):
    from datagen.blender.camera import read_pose

    positions = []
    for frame in range(0, session.spec.render.frames, 10):
        session.scene.frame_set(frame)
        positions.append(read_pose(session.scene)[:3, 3] - center)
    return np.array(positions) / np.linalg.norm(positions, axis=1, keepdims=True)


def test_everything_on_the_table_is_closed_and_rests_on_it(on_the_table):
    for name, parts in on_the_table.items():
        for part in parts:
            assert part.is_watertight, name
            assert part.volume > 0, name
    lowest = {
        name: min(part.vertices[:, 2].min() for part in parts) - TABLE_TOP for name, parts in on_the_table.items()
    }
    on_table = {name: height for name, height in lowest.items() if name not in NOT_ON_THE_TABLE}
    assert len(on_table) >= 8
    held_up = {"Plate", "Banana", "Pencil", "Apple", "Green apple", "Orange"}  # by the mat, the book, the bowl
    assert all(0 < height < 4e-4 for name, height in on_table.items() if name not in held_up), on_table
    assert all(0.002 < on_table[name] < 0.05 for name in held_up), on_table


@pytest.mark.parametrize(("above", "below"), [("Apple", "Bowl"), ("Orange", "Bowl"), ("Green apple", "Bowl")])
def test_fruit_lies_in_the_bowl_and_not_through_it(on_the_table, above, below):
    fruit, bowl = on_the_table[above][0], on_the_table[below][0]
    gaps = []
    for point in fruit.vertices[::60]:
        nearest = trimesh.triangles.closest_point(bowl.triangles, np.repeat(point[None], len(bowl.triangles), axis=0))
        closest = np.linalg.norm(nearest - point, axis=1).argmin()
        gaps.append((point - nearest[closest]) @ bowl.face_normals[closest])  # negative inside the wood
    assert min(gaps) > 0
    assert min(gaps) < 0.006


@pytest.mark.parametrize("name", ["suzanne", "bunny"])
def test_a_single_figure_is_seen_from_all_sides(shipped, name):
    directions = directions_seen_from(shipped(name), np.zeros(3))
    for wanted in trimesh.creation.icosphere(subdivisions=1).vertices:
        if -0.5 < wanted[2] < 0.95:
            assert (directions @ wanted).max() > np.cos(np.radians(40)), wanted


def test_the_table_is_seen_from_all_sides_and_from_above(shipped):
    directions = directions_seen_from(shipped("table"), np.array([0, 0, TABLE_TOP]))
    azimuths = np.degrees(np.arctan2(directions[:, 1], directions[:, 0]))
    assert np.histogram(azimuths, bins=12, range=(-180, 180))[0].min() > 0
    assert directions[:, 2].max() > np.sin(np.radians(55))
    assert 0.3 < directions[:, 2].min() < np.sin(np.radians(35))


@pytest.mark.parametrize("name", ["suzanne", "bunny", "table"])
def test_the_camera_keeps_clear_of_everything_with_its_subject_in_view(shipped, name):
    session = shipped(name)
    assert session.spec.render.frames == 500
    session.check_path()
