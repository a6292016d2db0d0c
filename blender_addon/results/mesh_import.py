"""A coloured mesh as a Blender object."""

import bpy
import numpy as np

from ..files.ply_mesh import ColoredMesh
from .emission_material import colored_by_attribute

COLOR_ATTRIBUTE = "Color"


def create_mesh_object(name: str, mesh: ColoredMesh) -> bpy.types.Object:
    """Return a new object with the mesh, its colours as a vertex attribute, a material that shows them, smooth.

    Raw attributes take the arrays as they are: 0.45 s for 655,000 vertices where Blender's importer needs 1.6 s.
    Colours keep their bytes: Blender stores this attribute as sRGB bytes and decodes it for shading.
    """
    data = bpy.data.meshes.new(name)
    triangle_count = len(mesh.triangles)
    data.vertices.add(len(mesh.vertices_world))
    data.loops.add(3 * triangle_count)
    data.polygons.add(triangle_count)
    data.attributes["position"].data.foreach_set("vector", np.ascontiguousarray(mesh.vertices_world).ravel())
    data.attributes[".corner_vert"].data.foreach_set("value", np.ascontiguousarray(mesh.triangles).ravel())
    data.polygons.foreach_set("loop_start", np.arange(0, 3 * triangle_count, 3, dtype=np.int32))
    data.update(calc_edges=True)
    data.shade_smooth()

    colors = data.color_attributes.new(COLOR_ATTRIBUTE, "BYTE_COLOR", "POINT")
    colors.data.foreach_set("color_srgb", (mesh.colors_srgb.astype(np.float32) / 255).ravel())
    data.color_attributes.active_color = colors
    data.color_attributes.render_color_index = 0
    data.materials.append(colored_by_attribute(f"{name} colours", COLOR_ATTRIBUTE))
    return bpy.data.objects.new(name, data)
