import time

import bpy
import numpy as np
import pytest
import trimesh

from blender_addon.files.ply_mesh import ColoredMesh
from blender_addon.results.mesh_import import COLOR_ATTRIBUTE, create_mesh_object


def _mesh(subdivisions: int) -> ColoredMesh:
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    generator = np.random.default_rng(1)
    return ColoredMesh(
        vertices_world=sphere.vertices.astype(np.float32),
        triangles=sphere.faces.astype(np.int32),
        colors_srgb=generator.integers(0, 256, (len(sphere.vertices), 4), dtype=np.uint8),
    )


@pytest.mark.usefixtures("empty_scene")
def test_coordinates_triangles_and_colours_come_back_as_they_went_in() -> None:
    mesh = _mesh(4)
    data = create_mesh_object("sphere", mesh).data
    coordinates = np.empty(mesh.vertices_world.size, np.float32)
    data.vertices.foreach_get("co", coordinates)
    np.testing.assert_array_equal(coordinates.reshape(-1, 3), mesh.vertices_world)
    assert [list(polygon.vertices) for polygon in data.polygons] == mesh.triangles.tolist()
    colors = np.empty(mesh.colors_srgb.size, np.float32)
    data.color_attributes[COLOR_ATTRIBUTE].data.foreach_get("color_srgb", colors)
    np.testing.assert_array_equal(np.rint(colors.reshape(-1, 4) * 255), mesh.colors_srgb)


@pytest.mark.usefixtures("empty_scene")
def test_colours_are_decoded_from_srgb_for_shading() -> None:
    mesh = _mesh(1)
    data = create_mesh_object("sphere", mesh).data
    linear = np.empty(mesh.colors_srgb.size, np.float32)
    data.color_attributes[COLOR_ATTRIBUTE].data.foreach_get("color", linear)
    srgb = mesh.colors_srgb[:, :3] / 255
    expected = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(linear.reshape(-1, 4)[:, :3], expected, atol=1e-4)


@pytest.mark.usefixtures("empty_scene")
def test_the_mesh_is_one_that_blender_would_make() -> None:
    data = create_mesh_object("sphere", _mesh(3)).data
    assert data.validate(verbose=False) is False  # nothing had to be mended
    assert len(data.vertices) - len(data.edges) + len(data.polygons) == 2  # Euler's number of a sphere
    assert all(polygon.use_smooth for polygon in data.polygons)
    assert data.color_attributes.active_color.name == COLOR_ATTRIBUTE
    assert data.color_attributes.active_color.domain == "POINT"


@pytest.mark.usefixtures("empty_scene")
def test_the_material_emits_the_colour_attribute() -> None:
    material = create_mesh_object("sphere", _mesh(1)).data.materials[0]
    surface = next(node for node in material.node_tree.nodes if node.type == "OUTPUT_MATERIAL").inputs["Surface"]
    emission = surface.links[0].from_node
    assert emission.type == "EMISSION"
    attribute = emission.inputs["Color"].links[0].from_node
    assert attribute.type == "VERTEX_COLOR"
    assert attribute.layer_name == COLOR_ATTRIBUTE


@pytest.mark.usefixtures("empty_scene")
def test_a_large_mesh_is_no_slower_than_blenders_own_importer(tmp_path: object) -> None:
    """Both make the same mesh; the margin is for a busy machine, alone ours takes a third of the time."""
    mesh = _mesh(7)
    triangles = trimesh.Trimesh(mesh.vertices_world, mesh.triangles, process=False)
    triangles.visual.vertex_colors = mesh.colors_srgb
    triangles.export(f"{tmp_path}/mesh.ply")
    start = time.perf_counter()
    bpy.ops.wm.ply_import(filepath=f"{tmp_path}/mesh.ply")
    blender_seconds = time.perf_counter() - start
    start = time.perf_counter()
    create_mesh_object("sphere", mesh)
    assert time.perf_counter() - start < 1.5 * blender_seconds
