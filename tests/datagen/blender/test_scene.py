"""A declared scene in Blender: its objects, where they stand, what they are made of."""

import numpy as np
import pytest
import trimesh

from datagen.color import linear_from_srgb
from datagen.shapes.lathe import lathe
from datagen.shapes.solid import triangles_of

CUP = [[0, 0], [0.3, 0], [0.4, 0.8], [0.35, 0.8], [0.25, 0.05], [0, 0.05]]


def ground_truth(session, tmp_path):
    session.write_ground_truth(tmp_path)
    return trimesh.load(tmp_path / "ground_truth" / "mesh.ply", process=False)


def render(session, frame=0):
    from datagen.blender.render import render_frame

    return render_frame(session.scene, frame, seed=0, scratch=session.scratch)


def test_a_shape_stands_in_the_ground_truth_as_it_was_computed(open_session, make_scene, tmp_path):
    session = open_session(
        make_scene(objects=[{"name": "Cup", "shape": "lathe", "profile": CUP, "bevel": 0.01, "material": "red"}])
    )
    mesh = ground_truth(session, tmp_path)
    solid = lathe(CUP, bevel=0.01)
    expected = trimesh.Trimesh(solid.vertices, triangles_of(solid), process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(expected.volume, rel=1e-5)
    np.testing.assert_allclose(mesh.vertices, solid.vertices, atol=1e-7)


def test_parts_move_turn_and_scale_with_their_object(open_session, make_scene, tmp_path):
    part = {"shape": "box", "size": [1, 2, 3], "material": "red", "location": [5, 0, 0], "rotation_deg": [90, 0, 0]}
    thing = {"name": "Thing", "parts": [part], "location": [0, 0, 1], "rotation_deg": [0, 0, 90], "scale": 2}
    mesh = ground_truth(open_session(make_scene(objects=[thing])), tmp_path)
    # Turned in its own place to 1 × 3 × 2, moved 5 along x, which the object's turn makes y, all doubled, then 1 up.
    np.testing.assert_allclose(mesh.bounds, [[-3, 9, -1], [3, 11, 3]], atol=1e-5)


def test_a_turned_part_of_a_stretched_object_is_sheared_as_the_product_of_both_says(open_session, make_scene, tmp_path):
    part = {"shape": "box", "size": [1, 1, 1], "material": "red", "rotation_deg": [0, 0, 45]}
    thing = {"name": "Thing", "parts": [part], "scale": [3, 1, 1]}
    mesh = ground_truth(open_session(make_scene(objects=[thing])), tmp_path)
    half = np.sqrt(0.5)
    corners = {tuple(np.round(corner, 4)) for corner in mesh.vertices[:, :2]}
    expected = [[3 * half, 0], [-3 * half, 0], [0, half], [0, -half]]
    assert corners == {tuple(np.round(np.array(corner) + 0.0, 4)) for corner in expected}


def test_pass_indices_count_the_objects_from_one_whatever_parts_they_have(open_session, make_scene):
    cube = {"shape": "cube", "material": "red"}
    session = open_session(
        make_scene(objects=[{"name": "Two", "parts": [cube, cube]}, {"name": "One", **cube}, {"name": "Last", **cube}])
    )
    indices = {thing.name: thing.pass_index for thing in session.scene.objects if thing.type == "MESH"}
    assert indices == {"Two.0": 1, "Two.1": 1, "One": 2, "Last": 3}


def test_the_bunny_is_closed_stands_on_zero_and_needs_no_warp_loaded(open_session, make_scene, tmp_path):
    import subprocess
    import sys

    bunny = {"name": "B", "shape": "bunny", "material": "red", "subdivision": 1, "smooth": True}
    mesh = ground_truth(open_session(make_scene(objects=[bunny])), tmp_path)
    assert mesh.is_watertight
    assert mesh.volume > 0
    plain = ground_truth(open_session(make_scene(objects=[bunny | {"subdivision": 0}])), tmp_path)
    assert plain.bounds[0, 2] == pytest.approx(0, abs=1e-6)
    assert np.ptp(plain.vertices[:, 0]) == pytest.approx(0.156, abs=1e-5)
    code = "import datagen.blender.scene, sys; sys.exit('warp' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_missing_bunny_is_said_and_what_to_install(open_session, make_scene, monkeypatch):
    import importlib.util

    from datagen.errors import InputError

    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"shape bunny: .*pip install 'warp-lang"):
        open_session(make_scene(objects=[{"name": "B", "shape": "bunny", "material": "red"}]))


def test_a_texture_of_one_colour_looks_like_that_colour(open_session, make_scene):
    texture = {"pattern": "print", "colors": ["#408040", "#408040"], "pixels": 64, "contrast": 0.0, "gloss": 0.0}
    scenes = [
        make_scene(materials={"m": material}, objects=[{"name": "B", "shape": "cube", "material": "m", "scale": 0.3}])
        for material in ({"color": "#408040"}, {"texture": texture})
    ]
    plain, textured = (render(open_session(scene)).color.astype(int) for scene in scenes)
    assert np.abs(plain - textured).max() <= 2


def test_a_picture_lies_upright_on_what_it_is_stretched_over(open_session, make_scene):
    """A label whose back is dark and whose front is light: seen from the front of a lying book, the spine is left."""
    cover = {
        "pattern": "print",
        "colors": ["#ffffff", "#000000"],
        "spine": 0.1,
        "text": ["M", "M", "M"],
        "motif": "sun",
    }
    session = open_session(
        make_scene(
            render={"frames": 1, "size": [160, 120], "samples": 16, "denoise": False},
            materials={"cover": {"texture": cover, "roughness": 1.0}, "pages": {"color": "#ffffff"}},
            objects=[
                {
                    "name": "Book",
                    "shape": "book",
                    "size": [1.2, 1.2, 0.1],
                    "material": "cover",
                    "inner_material": "pages",
                }
            ],
            keyframes=[{"time": 0, "position": [0, -0.01, 3], "look_at": [0, 0, 0]}],
            world={"color": "#ffffff", "strength": 1.0},
            lights=[],
        )
    )
    image = render(session).color.mean(axis=-1)
    rows, columns = np.nonzero(image < 250)
    page = image[rows.min() : rows.max(), columns.min() : columns.max()]
    height, width = page.shape
    # The motif's hills, dark, lie low on the front; its first line of text, a dark M, lies high.
    low, high = page[int(0.75 * height) : int(0.86 * height)], page[int(0.28 * height) : int(0.36 * height)]
    assert (
        low[:, int(0.2 * width) : int(0.8 * width)].mean() < 0.7 * high[:, int(0.2 * width) : int(0.8 * width)].mean()
    )


def test_parts_of_one_repeating_wood_show_different_grain(open_session, make_scene):
    wood = {"pattern": "wood", "colors": ["#c0a070", "#805030"], "size": [1.0, 0.5], "pixels": 64}
    box = {"shape": "box", "size": [1, 1, 1], "material": "wood"}
    session = open_session(
        make_scene(materials={"wood": {"texture": wood}}, objects=[{"name": "Table", "parts": [box, box]}])
    )
    places = []
    for thing in session.scene.objects:
        if thing.type == "MESH":
            uv = np.empty((len(thing.data.loops), 2), np.float32)
            thing.data.uv_layers["surface"].uv.foreach_get("vector", uv.ravel())
            places.append(uv)
    shift = places[1] - places[0]
    assert np.ptp(shift, axis=0).max() < 1e-5
    assert np.abs(shift).min() > 0.01


def test_a_sky_shines_with_its_own_colours_by_direction(open_session, make_scene):
    session = open_session(
        make_scene(
            world={
                "color": "#2060c0",
                "strength": 1.0,
                "sky": {"horizon": "#ffffff", "ground": "#000000", "clouds": 0},
            },
            keyframes=[{"time": 0, "position": [0, -2, 50], "look_at": [0, -4, 50.2]}],
        )
    )
    color = render(session).color.astype(float)
    assert color[0, :, 2].mean() - color[0, :, 0].mean() > 20  # bluer upwards
    horizon = color[30].mean()
    assert horizon > color[0].mean()
    assert color[-1].mean() < 0.8 * horizon
    top = linear_from_srgb(color[0].mean(axis=0) / 255)
    assert (top > linear_from_srgb(np.array([0x20, 0x60, 0xC0]) / 255)).all()
