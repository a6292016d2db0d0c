"""Models of every format as objects of a scene: geometry, axes, colours, and what is refused."""

import json

import numpy as np
import pytest
import trimesh

from datagen.color import linear_from_srgb
from datagen.errors import InputError
from datagen.scene_spec.model_files import content_sha256
from datagen.scene_spec.scene_files import read_scene

pytestmark = pytest.mark.usefixtures("blender")

SIZE = np.array([0.2, 0.4, 0.6])
SCENE = """
name = "own"
[render]
frames = 1
size = [64, 48]
samples = 4
denoise = false
[materials.red]
color = "#c02020"
[[objects]]
name = "Thing"
{keys}
[[lights]]
type = "sun"
position = [1, -2, 3]
power = 2
[[keyframes]]
time = 0
position = [0, -2, 0.3]
look_at = [0, 0, 0]
"""


def box():
    mesh = trimesh.creation.box(SIZE)
    mesh.apply_translation([0, 0, 0.3])
    return mesh


def save(folder, kind, mesh=None):
    """Write a model as its format has it: y up where the format says so, z up elsewhere."""
    mesh = mesh or box()
    path = folder / f"model{kind}"
    if kind == ".usda":
        points = ", ".join(f"({x}, {y}, {z})" for x, y, z in mesh.vertices)
        indices = ", ".join(str(i) for i in mesh.faces.ravel())
        counts = ", ".join("3" for _ in mesh.faces)
        path.write_text(
            '#usda 1.0\n( metersPerUnit = 1\n upAxis = "Z" )\ndef Mesh "box" {\n'
            f"int[] faceVertexCounts = [{counts}]\nint[] faceVertexIndices = [{indices}]\n"
            f"point3f[] points = [{points}]\n}}\n"
        )
        return path
    if kind in (".glb", ".gltf", ".obj"):
        mesh = mesh.copy()
        mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    if kind == ".gltf":
        for name, data in trimesh.exchange.gltf.export_gltf(mesh.scene()).items():
            (folder / (path.name if name == "model.gltf" else name)).write_bytes(data)
        return path
    mesh.export(path)
    return path


def scene_with(folder, keys):
    path = folder / "scene.toml"
    path.write_text(SCENE.format(keys=keys))
    return read_scene(path)


def ground_truth(session, folder):
    session.write_ground_truth(folder)
    return trimesh.load(folder / "ground_truth" / "mesh.ply", process=True)


def color_in_the_middle(session):
    from datagen.blender.render import render_frame

    color = render_frame(session.scene, 0, seed=0, scratch=session.scratch).color[20:28, 28:36]
    return linear_from_srgb(color / 255).mean(axis=(0, 1))


@pytest.mark.parametrize("kind", [".obj", ".ply", ".stl", ".glb", ".gltf", ".usda"])
def test_a_model_of_any_format_stands_upright_in_metres(open_session, tmp_path, kind):
    model = save(tmp_path, kind)
    scene = scene_with(tmp_path, f'file = "{model.name}"')
    mesh = ground_truth(open_session(scene), tmp_path)
    np.testing.assert_allclose(mesh.bounds, box().bounds, atol=1e-6)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(np.prod(SIZE), rel=1e-5)


def test_a_model_is_placed_scaled_and_indexed_as_any_object(open_session, tmp_path):
    save(tmp_path, ".ply")
    scene = scene_with(tmp_path, 'file = "model.ply"\nscale = 0.5\nrotation_deg = [0, 0, 90]\nlocation = [1, 0, 0]')
    session = open_session(scene)
    np.testing.assert_allclose(ground_truth(session, tmp_path).bounds, [[0.9, -0.05, 0], [1.1, 0.05, 0.3]], atol=1e-6)
    assert [thing.pass_index for thing in session.scene.objects if thing.type == "MESH"] == [1]


@pytest.mark.parametrize(("kind", "up"), [(".obj", "z"), (".ply", "y"), (".stl", "y")])
def test_the_axis_that_points_up_can_be_said(open_session, tmp_path, kind, up):
    mesh = box()
    if up == "z":  # save() turns OBJ to y up; here it is z up all the same
        mesh.export(tmp_path / f"model{kind}")
    else:
        mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
        mesh.export(tmp_path / f"model{kind}")
    scene = scene_with(tmp_path, f'file = "model{kind}"\nup_axis = "{up}"')
    np.testing.assert_allclose(ground_truth(open_session(scene), tmp_path).bounds, box().bounds, atol=1e-6)


@pytest.mark.parametrize("kind", [".ply", ".glb"])
def test_vertex_colours_are_shown(open_session, tmp_path, kind):
    mesh = box()
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=np.tile([20, 200, 30, 255], (len(mesh.vertices), 1)))
    save(tmp_path, kind, mesh)
    red, green, blue = color_in_the_middle(open_session(scene_with(tmp_path, f'file = "model{kind}"')))
    assert green > 2 * max(red, blue)


def test_a_model_keeps_its_own_material_unless_it_is_given_one(open_session, tmp_path):
    (tmp_path / "model.mtl").write_text("newmtl green\nKd 0.02 0.6 0.05\n")
    save(tmp_path, ".obj")
    text = (tmp_path / "model.obj").read_text()
    faces = text.index("\nf ")
    (tmp_path / "model.obj").write_text("mtllib model.mtl\n" + text[:faces] + "\nusemtl green" + text[faces:])
    own = color_in_the_middle(open_session(scene_with(tmp_path, 'file = "model.obj"')))
    given = color_in_the_middle(open_session(scene_with(tmp_path, 'file = "model.obj"\nmaterial = "red"')))
    assert own[1] > 2 * own[0]
    assert given[0] > 2 * given[1]


def test_a_missing_texture_is_said_and_not_shown_in_pink(open_session, tmp_path):
    (tmp_path / "model.mtl").write_text("newmtl wood\nmap_Kd wood.png\n")
    save(tmp_path, ".obj")
    text = (tmp_path / "model.obj").read_text()
    faces = text.index("\nf ")
    (tmp_path / "model.obj").write_text("mtllib model.mtl\n" + text[:faces] + "\nusemtl wood" + text[faces:])
    with pytest.raises(InputError, match=r"model.obj: its texture .*wood.png is missing; put it there"):
        open_session(scene_with(tmp_path, 'file = "model.obj"'))
    open_session(scene_with(tmp_path, 'file = "model.obj"\nmaterial = "red"'))


def test_a_missing_file_is_named_before_blender_starts(tmp_path):
    with pytest.raises(InputError, match=r"nowhere.glb: cannot be read \(No such file"):
        scene_with(tmp_path, 'file = "nowhere.glb"')


@pytest.mark.parametrize("kind", [".obj", ".ply", ".stl", ".glb", ".gltf", ".usda", ".blend"])
@pytest.mark.parametrize("content", [b"", b"\x00\x01 no model at all \xff" * 50])
def test_a_damaged_file_is_refused_by_name(open_session, tmp_path, kind, content):
    (tmp_path / f"model{kind}").write_bytes(content)
    with pytest.raises(InputError, match=f"model{kind}: .*(export it anew|save it anew|a mesh with faces is needed)"):
        open_session(scene_with(tmp_path, f'file = "model{kind}"'))


def test_a_model_without_faces_is_refused(open_session, tmp_path):
    (tmp_path / "model.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    with pytest.raises(InputError, match=r"model.obj: shows no surface; a mesh with faces is needed"):
        open_session(scene_with(tmp_path, 'file = "model.obj"'))


@pytest.mark.parametrize("kind", [".obj", ".ply", ".stl"])
@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_vertices_that_are_no_numbers_are_refused(open_session, tmp_path, kind, number):
    mesh = box()
    vertices = mesh.vertices.copy()
    vertices[3, 1] = number
    with np.errstate(invalid="ignore"):
        data = trimesh.Trimesh(vertices, mesh.faces, process=False, validate=False).export(file_type=kind[1:])
    (tmp_path / f"model{kind}").write_bytes(data if isinstance(data, bytes) else data.encode())
    with pytest.raises(InputError, match=f"model{kind}: has vertices that are not finite numbers; repair it"):
        open_session(scene_with(tmp_path, f'file = "model{kind}"'))


def test_the_recipe_knows_a_model_by_its_content_wherever_it_lies(tmp_path):
    from datagen.rendering.recipes import recipe_of

    recipes = []
    for name in ("here", "there"):
        folder = tmp_path / name
        folder.mkdir()
        save(folder, ".ply")
        recipes.append(recipe_of(scene_with(folder, 'file = "model.ply"')))
    assert recipes[0] == recipes[1]
    assert recipes[0]["objects"][0]["file"] == "model.ply"
    save(folder, ".ply", trimesh.creation.icosphere())
    assert recipe_of(scene_with(folder, 'file = "model.ply"')) != recipes[0]


def test_a_model_is_known_by_its_materials_and_buffers_too(tmp_path):
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\n")
    (tmp_path / "a.mtl").write_text("newmtl x\nmap_Kd -s 1 1 1 a.png\n")
    (tmp_path / "b.gltf").write_text(json.dumps({"buffers": [{"uri": "b%20c.bin"}]}))
    seen = set()
    for name, content in (("a.png", b"1"), ("a.png", b"2"), ("a.mtl", b"newmtl x\n"), ("b c.bin", b"1")):
        (tmp_path / name).write_bytes(content)
        seen.add(content_sha256(tmp_path / "a.obj") + content_sha256(tmp_path / "b.gltf"))
    assert len(seen) == 4


def test_a_sha256_of_another_content_is_refused(tmp_path):
    save(tmp_path, ".ply")
    with pytest.raises(InputError, match=r"model.ply: its SHA-256 is [0-9a-f]{64}, but objects\[0\].sha256 says 00"):
        scene_with(tmp_path, 'file = "model.ply"\nsha256 = "00"')
