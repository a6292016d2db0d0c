"""What the panel says: text that fits, lengths in the scene's units, why a step has to wait, what is automatic."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from blender_addon.panel.legend import Legend, legend_of, shows_colors
from blender_addon.panel.log_tail import last_lines, worth_showing
from blender_addon.panel.wrapped_text import wrap
from blender_addon.results.error_colors import put_errors
from blender_addon.results.import_reconstruction import import_reconstruction
from blender_addon.results.scene_collection import MESH_PART, parts
from blender_addon.results.scene_units import length_text
from blender_addon.steps import reasons
from blender_addon.steps.estimate import note_estimate
from blender_addon.steps.scan_source import fitting_distance

LETTERS = st.text(alphabet="iiimW w/.-é", max_size=60)
WIDTHS = {"i": 3.0, "m": 11.0, "W": 13.0, " ": 4.0}


def _measure(line: str) -> float:
    """A font whose letters are of different widths."""
    return sum(WIDTHS.get(letter, 7.0) for letter in line)


@given(text=LETTERS, width=st.floats(1, 200))
@example(text="/a/path/without/any/blank/that/is/wider/than/the/panel", width=60.0)
@example(text="", width=60.0)
def test_no_line_is_wider_than_its_place_and_no_letter_is_lost(text: str, width: float) -> None:
    lines = wrap(text, width, _measure)
    assert lines
    assert all(_measure(line) <= width or len(line) == 1 for line in lines)
    assert "".join("".join(lines).split()) == "".join(text.split())


@given(words=st.lists(st.text(alphabet="imW", min_size=1, max_size=6), min_size=1), width=st.floats(80, 200))
def test_words_that_fit_stay_whole_and_lines_take_as_many_as_fit(words: list[str], width: float) -> None:
    lines = wrap(" ".join(words), width, _measure)
    assert [word for line in lines for word in line.split(" ")] == words
    for line, after in pairwise(lines):
        assert _measure(f"{line} {after.split(' ')[0]}") > width


def test_the_log_has_as_many_lines_at_all_times_and_hides_only_what_is_no_news() -> None:
    said = [
        "Rendering",
        "Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. GPU ...",
        "Warp CUDA error: 2",
    ]
    assert worth_showing(said) == ["Rendering", "Warp CUDA error: 2"]
    for count in range(4):
        parts = [["a", "b"], ["c"]][: max(count - 1, 0)]
        assert len(last_lines(parts, 2)) == 2
    assert last_lines([["a", "b"], ["c"]], 2) == ["b", "c"]
    assert last_lines([["a"]], 3) == ["", "", "a"]


@pytest.mark.parametrize(
    ("system", "unit", "metres", "words"),
    [
        ("METRIC", "ADAPTIVE", 0.008782, "8.78 mm"),
        ("METRIC", "METERS", 0.0243, "2.43 cm"),
        ("METRIC", "MILLIMETERS", 0.0243, "24.3 mm"),
        ("METRIC", "MILLIMETERS", 2.4, "2,400 mm"),
        ("METRIC", "KILOMETERS", 12.0, "0.012 km"),
        ("IMPERIAL", "INCHES", 0.254, "10 in"),
        ("NONE", None, 0.125, "0.125"),
    ],
)
def test_lengths_are_said_in_the_scenes_units(
    empty_scene: bpy.types.Scene, system: str, unit: str | None, metres: float, words: str
) -> None:
    empty_scene.unit_settings.system = system
    if unit is not None:
        empty_scene.unit_settings.length_unit = unit
    empty_scene.unit_settings.scale_length = 0.01
    assert length_text(empty_scene, metres) == words


@pytest.mark.usefixtures("extension")
def test_an_empty_scene_is_not_scanned_and_says_so() -> None:
    settings = bpy.context.scene.scanback.scan
    assert reasons.why_not_scan(bpy.context) == "The scene has no object with a surface that renders; add one"
    settings.subject = "OBJECT"
    assert reasons.why_not_scan(bpy.context) == "There is no active object; select one, or scan the whole scene"
    bpy.ops.object.light_add()
    assert reasons.why_not_scan(bpy.context) == "Point has no surface that renders; select another object"
    bpy.ops.mesh.primitive_cube_add()
    assert reasons.why_not_scan(bpy.context) is None
    bpy.context.object.hide_render = True
    assert "no surface" in str(reasons.why_not_scan(bpy.context))
    settings.subject = "SCENE"
    assert "no object with a surface" in str(reasons.why_not_scan(bpy.context))


@pytest.mark.usefixtures("extension")
def test_a_chosen_length_begins_with_what_was_automatic(tmp_path: Path) -> None:
    scene = bpy.context.scene
    scene.unit_settings.scale_length = 0.01
    scene.scanback.folder = str(tmp_path)
    fuse = scene.scanback.fuse
    assert bpy.ops.scanback.choose_length(length="fuse.voxel_size") == {"FINISHED"}
    assert fuse.voxel_size == pytest.approx(1.0)  # a centimetre, where nothing is known
    assert bpy.ops.scanback.choose_length(length="fuse.voxel_size", automatic=True) == {"FINISHED"}
    assert fuse.voxel_size == 0
    note_estimate(tmp_path / "dataset", {"taxicab_area": 1.0, "voxel_size": 0.004, "devices": ["cpu"]})
    for length, expected in (("fuse.truncation", 1.6), ("fuse.voxel_size", 0.4)):
        bpy.ops.scanback.choose_length(length=length)
        assert getattr(fuse, length.partition(".")[2]) == pytest.approx(expected)
    bpy.ops.mesh.primitive_uv_sphere_add(radius=1)
    bpy.ops.scanback.choose_length(length="scan.distance")
    scan = scene.scanback.scan
    expected = fitting_distance(scene, None, "SCENE", width=scan.width, height=scan.height)
    assert scan.distance == pytest.approx(expected)
    # A ball of radius 1 is its own bounding sphere; 50 mm of lens on 36 mm see 15.1° up at 4 to 3.
    assert expected == pytest.approx(1 / np.sin(np.arctan(0.36 * 0.75)) / 0.9, rel=1e-3)


@pytest.mark.usefixtures("extension")
def test_every_length_that_can_be_automatic_has_a_setting_of_its_own() -> None:
    lengths = bpy.ops.scanback.choose_length.get_rna_type().properties["length"].enum_items
    for item in lengths:
        step, _, name = item.identifier.partition(".")
        prop = getattr(bpy.context.scene.scanback, step).bl_rna.properties[name]
        assert (prop.subtype, prop.default, prop.unit) == ("DISTANCE", 0.0, "LENGTH")
        assert "; 0 " in prop.description, item.identifier
        for automatic in (False, True):
            chosen: Any = type("Chosen", (), {"length": item.identifier, "automatic": automatic})
            assert bpy.types.SCANBACK_OT_choose_length.description(bpy.context, chosen)


@pytest.mark.usefixtures("extension")
def test_the_legend_is_there_while_errors_are_shown(sphere_scan: Any) -> None:
    scene = bpy.context.scene
    collection = import_reconstruction(scene, sphere_scan.folder)
    (item,) = parts(collection, MESH_PART)
    assert legend_of(bpy.context) is None
    put_errors(item, np.linspace(0, 0.01, len(item.data.vertices), dtype=np.float32), limit_m=0.005, numbers={})
    assert legend_of(bpy.context) == Legend(low="0", high="5 mm and more")
    item.hide_set(True)
    assert legend_of(bpy.context) is None
    item.hide_set(False)
    bpy.ops.scanback.show_colors(errors=False)
    assert legend_of(bpy.context) is None
    space = next(area for area in bpy.data.screens["Layout"].areas if area.type == "VIEW_3D").spaces.active
    for shading, color, shown in (
        ("SOLID", "VERTEX", True),
        ("SOLID", "MATERIAL", False),
        ("WIREFRAME", "VERTEX", False),
    ):
        space.shading.type, space.shading.color_type = shading, color
        assert shows_colors(space) == shown
    space.shading.type = "MATERIAL"
    space.overlay.show_overlays = False
    assert not shows_colors(space)
