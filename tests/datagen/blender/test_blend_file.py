"""A foreign .blend as a scene: what of it is rendered, what never runs, what is refused."""

import itertools
import math

import numpy as np
import pytest
import trimesh

from datagen.errors import InputError
from datagen.images import read_depth
from datagen.rigid import inverse
from datagen.scene_spec.scene_files import load_scene, read_scene, with_render_settings

pytestmark = pytest.mark.usefixtures("blender")


@pytest.fixture
def foreign(tmp_path):
    """Make a .blend with this process' Blender: ``build`` gets bpy and the empty scene, and fills it."""
    import bpy

    def make(build, *, camera=True):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        scene = bpy.context.scene
        scene.frame_start, scene.frame_end = 1, 5
        scene.render.resolution_x, scene.render.resolution_y = 64, 48
        if camera:
            data = bpy.data.cameras.new("Camera")
            scene.camera = bpy.data.objects.new("Camera", data)
            scene.collection.objects.link(scene.camera)
            scene.camera.location, scene.camera.rotation_euler = (0, -6, 0), (math.pi / 2, 0, 0)
        build(bpy, scene)
        path = tmp_path / "foreign.blend"
        bpy.ops.wm.save_as_mainfile(filepath=str(path))
        return path

    return make


def cube(bpy, name="Cube", size=1.0, **where):
    bpy.ops.mesh.primitive_cube_add(size=size, **where)
    thing = bpy.context.object
    thing.name = name
    return thing


def opened(open_session, path, **render):
    return open_session(with_render_settings(load_scene(str(path)), samples=1, denoise=False, **render))


def pieces(session, folder):
    session.write_ground_truth(folder)
    mesh = trimesh.load(folder / "ground_truth" / "mesh.ply", process=True)
    return sorted(mesh.split(only_watertight=False), key=lambda piece: tuple(np.round(piece.centroid, 3)))


def test_scripts_and_drivers_of_a_foreign_blend_never_run(foreign, open_session, tmp_path):
    by_text, by_driver = tmp_path / "text-ran", tmp_path / "driver-ran"

    def build(bpy, scene):
        text = bpy.data.texts.new("startup.py")
        text.write(f"open({str(by_text)!r}, 'w').close()")
        text.use_module = True  # registered: run when the file is opened
        driver = cube(bpy).driver_add("location", 2).driver
        driver.type = "SCRIPTED"
        driver.expression = f"(open({str(by_driver)!r}, 'w').close(), 0)[1]"

    path = foreign(build)
    for marker in (by_text, by_driver):
        marker.unlink(missing_ok=True)  # of what ran while it was being made
    session = opened(open_session, path)
    session.scene.frame_set(2)
    scene_file = tmp_path / "scene.toml"
    scene_file.write_text(
        'name = "own"\n[[objects]]\nname = "A"\nfile = "foreign.blend"\n'
        "[[keyframes]]\ntime = 0\nposition = [0, -2, 0]\nlook_at = [0, 0, 0]\n"
    )
    open_session(read_scene(scene_file))
    assert not by_text.exists()
    assert not by_driver.exists()

    # The sting: Blender does run them where it is told to trust the file.
    import bpy

    bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False, use_scripts=True)
    assert by_text.exists()
    bpy.ops.wm.read_factory_settings(use_empty=True)


def test_what_is_rendered_is_what_stands_in_the_ground_truth(foreign, open_session, tmp_path):
    def build(bpy, scene):
        rounded = cube(bpy, "Rounded")
        modifier = rounded.modifiers.new("Subdivision", "SUBSURF")
        modifier.levels, modifier.render_levels = 0, 2
        cube(bpy, "Hidden in renders", location=(10, 0, 0)).hide_render = True
        cube(bpy, "Hidden in the viewport", location=(20, 0, 0)).hide_viewport = True
        unused = cube(bpy, "Modifier for the viewport only", location=(30, 0, 0)).modifiers.new("Array", "ARRAY")
        unused.show_render = False
        bpy.ops.object.metaball_add(location=(40, 0, 0))
        bpy.ops.object.text_add(location=(50, 0, 0))
        bpy.context.object.data.extrude = 0.1
        bpy.ops.curve.primitive_bezier_circle_add(location=(60, 0, 0))
        bpy.context.object.data.bevel_depth = 0.1

    session = opened(open_session, foreign(build))
    found = pieces(session, tmp_path)
    at = {round(piece.bounds.mean(axis=0)[0], -1) for piece in found}
    assert at == {0, 20, 30, 40, 50, 60}
    rounded = next(piece for piece in found if abs(piece.centroid[0]) < 1)
    assert len(rounded.faces) == 2 * 6 * 16
    assert np.ptp(next(p for p in found if abs(p.centroid[0] - 30) < 2).vertices[:, 0]) == pytest.approx(1)


def test_instances_stand_where_they_are_shown_each_an_object_of_its_own(foreign, open_session, tmp_path):
    def build(bpy, scene):
        original = cube(bpy, "Original")
        collection = bpy.data.collections.new("Instanced")
        scene.collection.objects.unlink(original)
        collection.objects.link(original)
        for i, scale in enumerate(((1, 1, 1), (2, 1, -1))):
            empty = bpy.data.objects.new(f"Instance {i}", None)
            empty.instance_type, empty.instance_collection = "COLLECTION", collection
            empty.location, empty.scale = (5 * i, 0, 1), scale
            scene.collection.objects.link(empty)
        # A turned child of a stretched parent is sheared.
        parent = bpy.data.objects.new("Parent", None)
        parent.scale, parent.location = (3, 1, 1), (10, 0, 0)
        scene.collection.objects.link(parent)
        child = cube(bpy, "A child")
        child.parent, child.rotation_euler = parent, (0, 0, math.pi / 4)

    session = opened(open_session, foreign(build))
    found = pieces(session, tmp_path)
    np.testing.assert_allclose([piece.bounds.mean(axis=0) for piece in found], [[0, 0, 1], [5, 0, 1], [10, 0, 0]])
    assert [piece.volume for piece in found] == pytest.approx([1, 2, 3])
    np.testing.assert_allclose(np.ptp(found[2].vertices, axis=0), [3 * math.sqrt(2), math.sqrt(2), 1], rtol=1e-5)
    assert {thing.name: thing.pass_index for thing in meshes(session)} == {
        "A child": 1,
        "Instance 0": 2,
        "Instance 1": 3,
    }


def meshes(session):
    return [thing for thing in session.scene.objects if thing.type == "MESH"]


def test_pass_indices_follow_the_names_behind_the_scene_files_own_objects(foreign, open_session, tmp_path):
    def build(bpy, scene):
        for name, x in (("Zebra", 3), ("Ape", 6)):
            cube(bpy, name, location=(x, 0, 0))

    foreign(build)
    (tmp_path / "scene.toml").write_text(
        'name = "both"\n[render]\nframes = 1\n[blend]\nfile = "foreign.blend"\n[materials.m]\ncolor = "#ffffff"\n'
        '[[objects]]\nname = "Ours"\nshape = "cube"\nmaterial = "m"\n'
    )
    session = open_session(read_scene(tmp_path / "scene.toml"))
    indices = {round(thing.matrix_world.translation.x): thing.pass_index for thing in meshes(session)}
    assert indices == {0: 1, 6: 2, 3: 3}


def test_its_own_camera_moves_as_in_the_blend_with_its_lens_size_and_rate(foreign, open_session):
    from datagen.blender.camera import read_intrinsics, read_pose

    path_of_camera = [(-2, -6, 0.5), (2, -5, 1.5)]

    def build(bpy, scene):
        cube(bpy)
        camera = scene.camera
        camera.data.lens, camera.data.sensor_width, camera.data.sensor_fit = 40, 32, "HORIZONTAL"
        camera.data.shift_x = 0.1
        camera.data.dof.use_dof = True
        parent = bpy.data.objects.new("Dolly", None)
        scene.collection.objects.link(parent)
        camera.parent, camera.location = parent, (0, 0, 0)
        for frame, place in zip((1, 5), path_of_camera, strict=True):
            parent.location = place
            parent.keyframe_insert("location", frame=frame)
        for curve in parent.animation_data.action.layers[0].strips[0].channelbags[0].fcurves:
            for key in curve.keyframe_points:
                key.interpolation = "LINEAR"
        scene.render.fps, scene.render.use_motion_blur = 12, True

    spec = load_scene(str(foreign(build)))
    assert (spec.render.frames, spec.render.size, spec.render.frames_per_second) == (5, (64, 48), 12)
    session = open_session(spec)
    camera = read_intrinsics(session.scene)
    assert camera.fx == pytest.approx(40 / 32 * 64)
    assert camera.cx == pytest.approx(64 / 2 - 0.5 - 0.1 * 64)
    assert not session.scene.camera.data.dof.use_dof
    assert not session.scene.render.use_motion_blur
    for frame, share in enumerate(np.linspace(0, 1, 5)):
        session.scene.frame_set(frame)
        pose = read_pose(session.scene)
        np.testing.assert_allclose(
            pose[:3, 3], (1 - share) * np.array(path_of_camera[0]) + share * np.array(path_of_camera[1]), atol=1e-5
        )
        np.testing.assert_allclose(inverse(pose)[:3, :3] @ [0, 1, 0], [0, 0, 1], atol=1e-5)  # it looks along y


def test_all_but_the_camera_holds_still(foreign, open_session, tmp_path):
    def build(bpy, scene):
        thing = cube(bpy)
        for frame, x in ((1, 1.0), (5, 4.0)):
            thing.location.x = x
            thing.keyframe_insert("location", frame=frame)

    session = opened(open_session, foreign(build))
    for frame in range(5):
        session.scene.frame_set(frame)
        assert pieces(session, tmp_path)[0].centroid[0] == pytest.approx(1.0)


def test_without_a_camera_the_scene_is_seen_from_all_sides_in_whole(foreign, open_session, tmp_path):
    from datagen.blender.camera import read_intrinsics, read_pose
    from datagen.rigid import transform_points

    def build(bpy, scene):
        cube(bpy, size=4, location=(10, 20, 30))

    path = foreign(build, camera=False)
    session = opened(open_session, path, frames=25, size=(64, 48))
    camera = read_intrinsics(session.scene)
    corners = np.array(list(itertools.product((8, 12), (18, 22), (28, 32))), float)
    seen_from = []
    for frame in range(25):
        session.scene.frame_set(frame)
        pose = read_pose(session.scene)
        pixels = camera.project(transform_points(inverse(pose), corners))
        assert (pixels > 0).all()
        assert (pixels < [63, 47]).all()
        seen_from.append(pose[:3, 3] - [10, 20, 30])
    directions = np.array(seen_from) / np.linalg.norm(seen_from, axis=1, keepdims=True)
    assert (directions.max(axis=0) > [0.8, 0.8, 0.8]).all()
    assert (directions.min(axis=0) < [-0.8, -0.8, -0.3]).all()


def test_an_unlit_blend_gets_light_and_a_lit_one_keeps_its_own(foreign, open_session):
    def unlit(bpy, scene):
        cube(bpy)

    def lit(bpy, scene):
        cube(bpy)
        sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
        scene.collection.objects.link(sun)

    assert len(load_scene(str(foreign(unlit))).lights) == 2
    spec = load_scene(str(foreign(lit)))
    assert spec.lights == ()
    session = open_session(spec)
    assert [thing.name for thing in session.scene.objects if thing.type == "LIGHT"] == ["Sun"]


def test_a_blend_that_zooms_is_refused(foreign):
    def build(bpy, scene):
        cube(bpy)
        for frame, lens in ((1, 50), (5, 60)):
            scene.camera.data.lens = lens
            scene.camera.data.keyframe_insert("lens", frame=frame)

    with pytest.raises(
        InputError, match=r"foreign.blend: its camera Camera zooms or shifts at frame 2; .*keep the lens"
    ):
        load_scene(str(foreign(build)))


@pytest.mark.parametrize("kind", ["ORTHO", "PANO"])
def test_a_camera_without_planar_depth_is_refused(foreign, kind):
    def build(bpy, scene):
        cube(bpy)
        scene.camera.data.type = kind

    with pytest.raises(InputError, match=f"foreign.blend: its camera Camera is {kind.lower()}; only perspective"):
        load_scene(str(foreign(build)))


def test_a_blend_without_a_surface_is_refused(foreign):
    with pytest.raises(InputError, match=r"foreign.blend: shows no surface; a mesh with faces is needed"):
        load_scene(str(foreign(lambda *_: None)))


@pytest.mark.parametrize("node", ["ShaderNodeBsdfTransparent", "ShaderNodeBsdfGlass", "ShaderNodeVolumeScatter"])
def test_a_material_that_depth_cannot_be_had_of_is_refused(foreign, node):
    def build(bpy, scene):
        material = bpy.data.materials.new("Window")
        if material.node_tree is None:
            material.use_nodes = True
        tree = material.node_tree
        shader = tree.nodes.new(node)
        output = next(n for n in tree.nodes if n.type == "OUTPUT_MATERIAL")
        tree.links.new(shader.outputs[0], output.inputs["Volume" if "Volume" in node else "Surface"])
        cube(bpy).data.materials.append(material)

    with pytest.raises(InputError, match=r"foreign.blend: the material Window uses a .*a depth camera has no surface"):
        load_scene(str(foreign(build)))


def test_see_through_settings_are_closed_and_displacement_stays_in_the_shading(foreign, open_session):
    from datagen.blender.render import render_frame

    def build(bpy, scene):
        material = bpy.data.materials.new("Clear")
        if material.node_tree is None:
            material.use_nodes = True
        surface = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
        surface.inputs["Alpha"].default_value = 0.0
        surface.inputs["Transmission Weight"].default_value = 1.0
        material.displacement_method = "DISPLACEMENT"
        cube(bpy, size=4).data.materials.append(material)

    session = opened(open_session, foreign(build))
    depth = render_frame(session.scene, 0, seed=0, scratch=session.scratch).depth
    assert depth[24, 32] == pytest.approx(4.0, abs=1e-5)


def test_a_changed_file_is_another_recipe(foreign, tmp_path):
    from datagen.rendering.recipes import first_difference, recipe_of

    recipes = []
    for size in (1.0, 2.0):
        path = foreign(lambda bpy, _, size=size: cube(bpy, size=size))
        recipes.append(recipe_of(load_scene(str(path))))
    assert recipes[0]["blend"]["file"] == "foreign.blend"
    key, before, now = first_difference(*recipes)
    assert key == "blend.sha256"
    assert before != now


SEEN_FROM_SIX_UNITS = """
name = "centimetres"
blend = {{ file = "{file}" }}
keyframes = [{{ time = 0, position = [0, -6, 0], look_at = [0, 0, 0] }}]
render = {{ frames = 1, size = [64, 48], samples = 1, denoise = false, depth_scale = 2e-6, metres_per_unit = 0.01 }}
"""


def test_a_scene_in_centimetres_is_written_in_metres(foreign, open_session, tmp_path):
    """A cube two units wide seen from six units away, where a unit is a centimetre."""

    def build(bpy, scene):
        scene.unit_settings.scale_length = 0.01
        cube(bpy, size=2)

    (tmp_path / "scene.toml").write_text(SEEN_FROM_SIX_UNITS.format(file=foreign(build, camera=False)))
    session = open_session(read_scene(tmp_path / "scene.toml"))
    session.write_frame(tmp_path / "out", 0)
    scale, frame = session.spec.render.depth_scale, tmp_path / "out" / "frames" / "frame-000000"
    depth = read_depth(frame.with_suffix(".depth.png"), size=(64, 48), metres_per_step=scale)
    np.testing.assert_allclose(np.unique(depth), (0, 0.05), atol=scale)
    pose = np.loadtxt(frame.with_suffix(".pose.txt"))
    np.testing.assert_allclose(pose[:3, 3], (0, -0.06, 0), atol=1e-8)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    (truth,) = pieces(session, tmp_path / "out")
    np.testing.assert_allclose(truth.bounds, [[-0.01] * 3, [0.01] * 3], atol=1e-8)


def test_without_a_system_of_units_a_unit_is_a_metre(foreign, blender):
    from datagen.blender.measure import measure

    for system, expected in (("NONE", 1.0), ("METRIC", 1e-3), ("IMPERIAL", 1e-3)):

        def build(bpy, scene, system=system):
            scene.unit_settings.system, scene.unit_settings.scale_length = system, 1e-3
            cube(bpy)

        assert measure(foreign(build))["metres_per_unit"] == expected
