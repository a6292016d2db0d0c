import json

import pytest

from datagen.errors import InputError
from datagen.scene_spec.scene import Scene
from datagen.scene_spec.scene_files import load_scene, read_scene, shipped_scenes, with_render_settings

MINIMAL = """
name = "test"
[render]
frames = 10
[materials.clay]
color = "#ff8000"
[[objects]]
name = "Ball"
shape = "sphere"
material = "clay"
scale = 0.5
[[lights]]
type = "point"
position = [0, 0, 2]
power = 10
[[keyframes]]
time = 0
position = [0, -2, 0]
look_at = [0, 0, 0]
[[keyframes]]
time = 0.5
position = [2, 0, 0]
look_at = [0, 0, 0]
"""


def read(tmp_path, text):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return read_scene(path)


def test_colours_are_srgb_in_either_spelling_and_scales_one_number_or_three(tmp_path):
    scene = read(tmp_path, MINIMAL)
    assert scene.materials["clay"].color == (1.0, 128 / 255, 0.0)
    assert scene.objects[0].scale == (0.5, 0.5, 0.5)
    other = MINIMAL.replace('"#ff8000"', "[1, 0.5, 0]").replace("scale = 0.5", "scale = [1, 2, 3]")
    assert read(tmp_path, other).materials["clay"].color == (1.0, 0.5, 0.0)
    assert read(tmp_path, other).objects[0].scale == (1.0, 2.0, 3.0)


def test_a_scene_survives_json_unchanged(tmp_path):
    scene = read(tmp_path, MINIMAL)
    assert Scene.model_validate_json(json.dumps(scene.model_dump(mode="json"))) == scene


@pytest.mark.parametrize(
    ("right", "wrong", "complaint"),
    [
        ("frames = 10", "frmaes = 10", "render.frmaes: unknown key; did you mean frames.*allowed here: frames, size"),
        ("power = 10", "powr = 10", r"lights\[0\].powr: unknown key; did you mean power"),
        ('color = "#ff8000"', 'color = "#ff8000"\nrougness = 1', "materials.clay.rougness: .*did you mean roughness"),
        ('name = "test"', 'name = "test"\nkeyframe = 1', "keyframe: unknown key; did you mean keyframes"),
        ("frames = 10", "frames = -3", "render.frames: expected greater than or equal to 1, found -3"),
        ("frames = 10", 'frames = "10"', "render.frames: expected a valid integer, found '10'"),
        ("frames = 10", "frames = true", "render.frames: expected a valid integer, found True"),
        ("frames = 10", "size = [640]", r"render.size\[1\]: missing"),
        ("frames = 10", "size = [640, 0]", r"render.size\[1\]: expected greater than or equal to 1, found 0"),
        ("frames = 10", "depth_scale = nan", "render.depth_scale: expected a finite number"),
        ("scale = 0.5", "scale = -0.5", r"objects\[0\].scale\[0\]: expected greater than 0, found -0.5"),
        ('shape = "sphere"', 'shape = "ball"', r"objects\[0\].shape: expected 'suzanne', 'sphere'"),
        ('material = "clay"', 'material = "cly"', r"objects\[0\].material: no material 'cly'; there are: clay"),
        ("#ff8000", "orange", 'materials.clay.color: expected "#RRGGBB" or three numbers'),
        ("power = 10", "power = -1", r"lights\[0\].power: expected greater than or equal to 0"),
        ("power = 10", "power = 10\nangle_deg = 3", r"lights\[0\]: angle_deg has no meaning for a light of type point"),
        ("time = 0.5", "time = 0", r"keyframes: times must increase, but key \[1\] has time 0"),
        ("time = 0.5", "time = 1.5", r"keyframes\[1\].time: expected less than or equal to 1"),
        ("position = [2, 0, 0]\nlook_at = [0, 0, 0]", "position = [2, 0, 0]", r"keyframes\[1\]: give exactly one of"),
        (
            "position = [2, 0, 0]\nlook_at",
            "position = [2, 0, 0]\nquat_wxyz = [1, 0, 0, 0]\nlook_at",
            r"keyframes\[1\]: give exactly one of",
        ),
        (
            "position = [2, 0, 0]\nlook_at = [0, 0, 0]",
            "position = [2, 0, 0]\nquat_wxyz = [1, 0, 0, 0]",
            r"keyframes: use look_at in all keys or quat_wxyz in all; keys \[0\] and \[1\] differ",
        ),
        (
            "position = [2, 0, 0]\nlook_at = [0, 0, 0]",
            "position = [2, 0, 0]\nquat_wxyz = [1, 1, 0, 0]",
            r"keyframes\[1\]: quat_wxyz .* must have length 1",
        ),
        ("position = [2, 0, 0]", "position = [0, 0, 3]", r"keyframes\[1\]: .*straight above or below"),
        ("position = [2, 0, 0]", "position = [0, 0, 0]", r"keyframes\[1\]: look_at must not lie at"),
    ],
)
def test_a_fault_is_named_by_file_key_and_what_belongs_there(tmp_path, right, wrong, complaint):
    assert right in MINIMAL
    with pytest.raises(InputError, match=f"scene.toml: {complaint}"):
        read(tmp_path, MINIMAL.replace(right, wrong, 1))


def test_two_objects_of_one_name_are_refused(tmp_path):
    second = '[[objects]]\nname = "Ball"\nshape = "cube"\nmaterial = "clay"\n'
    with pytest.raises(InputError, match=r"objects \[0\] and \[1\] have the same name, 'Ball'"):
        read(tmp_path, MINIMAL + second)


def test_a_scene_needs_an_object_and_a_key(tmp_path):
    for table in ("objects", "keyframes"):
        kept = [block for block in MINIMAL.split("[[") if not block.startswith(table)]
        with pytest.raises(InputError, match=f"{table}: missing"):
            read(tmp_path, "[[".join(kept))


def test_a_syntax_error_names_its_line(tmp_path):
    with pytest.raises(InputError, match=r"scene.toml: not valid TOML: .*line 4"):
        read(tmp_path, MINIMAL.replace("frames = 10", "frames = = 10"))


def test_an_unknown_scene_lists_those_there_are():
    with pytest.raises(InputError, match=r"suzane: no scene of this name; did you mean suzanne.*suzanne"):
        load_scene("suzane")
    with pytest.raises(InputError, match=r"nowhere/x.toml: cannot be read"):
        load_scene("nowhere/x.toml")


def test_every_scene_that_comes_along_is_valid_and_bears_its_name():
    assert "suzanne" in shipped_scenes()
    for name in shipped_scenes():
        assert load_scene(name).name == name


def test_replaced_render_settings_are_checked_too(tmp_path):
    scene = read(tmp_path, MINIMAL)
    changed = with_render_settings(scene, frames=3, size=(32, 24))
    assert (changed.render.frames, changed.render.size, scene.render.frames) == (3, (32, 24), 10)
    with pytest.raises(InputError, match="samples: expected greater than or equal to 1, found 0"):
        with_render_settings(scene, samples=0)
