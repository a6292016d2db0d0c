"""Objects that no viewport shows are compared as they would be seen."""

import bpy
import pytest

from blender_addon.errors import ReconstructionError
from blender_addon.steps.compare import triangles_of
from blender_addon.steps.evaluation import evaluated_as_shown

pytestmark = pytest.mark.usefixtures("extension")


def _cube() -> bpy.types.Object:
    bpy.ops.mesh.primitive_cube_add()
    return bpy.context.object


@pytest.mark.parametrize("hide", ["eye", "screen", "collection's eye", "collection's screen"])
def test_a_hidden_object_is_taken_as_its_modifiers_make_it(hide: str) -> None:
    """Blender evaluates nothing that no viewport shows: what is hidden must be shown for that."""
    scene = bpy.context.scene
    group = bpy.data.collections.new("Group")
    scene.collection.children.link(group)
    cube = _cube()
    group.objects.link(cube)
    scene.collection.objects.unlink(cube)
    cube.modifiers.new("Subdivision", "SUBSURF").levels = 1
    layer = bpy.context.view_layer.layer_collection.children["Group"]
    bpy.context.view_layer.update()
    if hide == "eye":
        cube.hide_set(True)
    else:
        owner = {"screen": cube, "collection's eye": layer, "collection's screen": group}[hide]
        owner.hide_viewport = True
    cube.location.x = 5
    bpy.context.view_layer.update()
    vertices, triangles = triangles_of(cube)
    assert len(triangles) == 2 * 4 * 6
    assert vertices[:, 0].mean() == pytest.approx(5, abs=1e-5)
    assert not cube.visible_get()
    with evaluated_as_shown([cube]):
        assert cube.visible_get()
    assert not cube.visible_get()


def test_an_object_that_the_view_layer_excludes_is_refused() -> None:
    group = bpy.data.collections.new("Group")
    bpy.context.scene.collection.children.link(group)
    cube = _cube()
    group.objects.link(cube)
    bpy.context.scene.collection.objects.unlink(cube)
    bpy.context.view_layer.layer_collection.children["Group"].exclude = True
    with pytest.raises(ReconstructionError, match="Cube is excluded from the view layer; include its collection"):
        triangles_of(cube)
