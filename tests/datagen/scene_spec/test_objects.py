import json

import pytest
from pydantic import ValidationError

from datagen.scene_spec.materials import MaterialSettings
from datagen.scene_spec.objects import ObjectSettings

RING = [[1, 0], [2, 0], [2, 1], [1, 0]]


def read(**content):
    return ObjectSettings.model_validate_json(json.dumps({"name": "A"} | content))


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ({}, "exactly one of shape, file and parts"),
        ({"shape": "cube"}, "material: missing"),
        ({"shape": "cube", "material": "m", "file": "a.obj"}, "one of shape and file, not both"),
        ({"shape": "lathe", "material": "m"}, "a lathe needs profile"),
        ({"shape": "lathe", "material": "m", "profile": [[0, 0], [1, 0], [1, 1]]}, "begin and end at radius 0"),
        ({"shape": "lathe", "material": "m", "profile": [[0, 0], [0, 1], [1, 1], [0, 2]]}, "begin and end at radius 0"),
        ({"shape": "lathe", "material": "m", "profile": [[0, 0], [-1, 0], [0, 1]]}, "greater than or equal to 0"),
        ({"shape": "tube", "material": "m", "path": [[0, 0, 0], [1, 0, 0]]}, "a tube needs radius"),
        ({"shape": "tube", "material": "m", "path": [[0, 0, 0], [0, 0, 0]], "radius": 1}, "at least two points"),
        ({"shape": "tube", "material": "m", "path": [[0, 0, 0], [1, 0, 0]], "radius": [1]}, "1 numbers for the 2"),
        ({"shape": "box", "material": "m"}, "a box needs size"),
        ({"shape": "box", "material": "m", "size": [1, 1, 0]}, "greater than 0"),
        ({"shape": "book", "material": "m", "size": [1, 1, 1]}, "a book needs inner_material"),
        ({"shape": "cube", "material": "m", "bevel": 0.1}, "bevel has no meaning for cube"),
        ({"file": "a.obj", "profile": RING}, "profile has no meaning for a file"),
        ({"file": "a.fbx"}, "no known format of models; known are .blend, .glb"),
        ({"file": "a.glb", "up_axis": "y"}, "up_axis has a meaning for .obj, .ply, .stl only"),
        ({"shape": "cube", "material": "m", "sha256": "00"}, "sha256 has no meaning without file"),
        ({"parts": [{"shape": "cube", "material": "m"}], "material": "m"}, "material belongs into the parts"),
        ({"parts": [{"location": [0, 0, 0]}]}, r"parts\[0\]: give shape or file"),
    ],
)
def test_a_fault_says_what_belongs_there(content, complaint):
    with pytest.raises(ValidationError, match=complaint):
        read(**content)


def test_an_object_is_its_own_part_or_has_parts():
    single = read(shape="lathe", profile=RING, material="m")
    assert single.all_parts == (single,)
    several = read(parts=[{"shape": "box", "size": [1, 1, 1], "material": "m"}] * 2, location=[1, 2, 3])
    assert len(several.all_parts) == 2


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ({}, "exactly one of color and texture"),
        ({"color": "#ffffff", "texture": {"pattern": "wood", "colors": ["#ffffff", "#000000"]}}, "exactly one of"),
        ({"texture": {"pattern": "wood", "colors": ["#ffffff"]}}, "at least 2 items"),
        ({"texture": {"pattern": "wood", "colors": ["#ffffff", "#000000"], "tiles": [1, 1]}}, "tiles has no meaning"),
        ({"texture": {"pattern": "bark", "colors": ["#ffffff", "#000000"]}}, "'wood', 'tiles'"),
    ],
)
def test_a_material_has_one_source_of_colour(content, complaint):
    with pytest.raises(ValidationError, match=complaint):
        MaterialSettings.model_validate_json(json.dumps(content))
