"""The shapes of a scene file as Blender meshes."""

import importlib.util
from pathlib import Path

import bpy
import numpy as np

from datagen.errors import InputError
from datagen.scene_spec.objects import PartSettings
from datagen.shapes.boxes import book, box
from datagen.shapes.lathe import lathe
from datagen.shapes.solid import Solid
from datagen.shapes.tube import tube

UV_METRES, UV_UNIT = "metres", "unit"
"""Places on a picture that repeats (metres), and on one that is stretched over the whole part once."""

BUNNY_WIDTH = 0.156
BUNNY_FILE = "examples/assets/bunny.usd"


def shape_mesh(part: PartSettings) -> bpy.types.Mesh:
    """Return a new mesh of a part's shape, without materials, in the shape's own axes.

    Raises InputError where the bunny is asked for and not there.
    """
    if part.shape == "lathe":
        assert part.profile is not None
        return mesh_of(lathe(part.profile, bevel=part.bevel, spline=bool(part.spline)), name=part.shape)
    if part.shape == "tube":
        assert part.path is not None
        assert part.radius is not None
        return mesh_of(tube(part.path, part.radius), name=part.shape)
    if part.shape == "box":
        assert part.size is not None
        return mesh_of(box(part.size, bevel=part.bevel or 0.0), name=part.shape)
    if part.shape == "book":
        assert part.size is not None
        return mesh_of(book(part.size), name=part.shape)
    shape = _bunny() if part.shape == "bunny" else _primitive(str(part.shape))
    mesh = shape.data
    bpy.data.objects.remove(shape)
    mesh.materials.clear()
    mesh.polygons.foreach_set("use_smooth", [part.smooth] * len(mesh.polygons))
    return mesh


def mesh_of(solid: Solid, *, name: str) -> bpy.types.Mesh:
    """Return a solid as a new mesh, with its normals, its material slots and both of its UV maps."""
    mesh = bpy.data.meshes.new(name)
    starts = np.concatenate([[0], np.cumsum(solid.sizes)[:-1]])
    mesh.vertices.add(len(solid.vertices))
    mesh.vertices.foreach_set("co", solid.vertices.astype(np.float32).ravel())
    mesh.loops.add(len(solid.corners))
    mesh.loops.foreach_set("vertex_index", solid.corners)
    mesh.polygons.add(len(solid.sizes))
    mesh.polygons.foreach_set("loop_start", starts.astype(np.int32))
    mesh.polygons.foreach_set("material_index", solid.slots)
    mesh.polygons.foreach_set("use_smooth", np.full(len(solid.sizes), solid.normals is not None))
    for layer, places in ((UV_METRES, solid.uv_metres), (UV_UNIT, solid.uv_unit)):
        mesh.uv_layers.new(name=layer).uv.foreach_set("vector", places.astype(np.float32).ravel())
    mesh.update(calc_edges=True)
    if solid.normals is not None:
        mesh.normals_split_custom_set_from_vertices(solid.normals.astype(np.float32))
    assert not mesh.validate(), f"the shape {name} makes a mesh that Blender has to repair"
    return mesh


def _primitive(shape: str) -> bpy.types.Object:
    """Add a primitive at the origin, round ones finely enough that their facets are not seen."""
    mesh = bpy.ops.mesh
    if shape == "suzanne":
        mesh.primitive_monkey_add()
    elif shape == "sphere":
        mesh.primitive_ico_sphere_add(subdivisions=6, radius=1.0)
    elif shape == "cube":
        mesh.primitive_cube_add(size=2.0)
    elif shape == "plane":
        mesh.primitive_plane_add(size=2.0)
    elif shape == "cylinder":
        mesh.primitive_cylinder_add(vertices=128, radius=1.0, depth=2.0)
    elif shape == "cone":
        mesh.primitive_cone_add(vertices=128, radius1=1.0, depth=2.0)
    elif shape == "torus":
        mesh.primitive_torus_add(major_segments=128, minor_segments=48, major_radius=1.0, minor_radius=0.25)
    else:
        raise AssertionError(f"shape {shape} is declared in scene_spec but not made here")
    return bpy.context.object


def _bunny() -> bpy.types.Object:
    """Read Stanford's bunny from Warp's examples (Warp itself is not loaded) and set it on z = 0, facing −y."""
    package = importlib.util.find_spec("warp")
    folders = list(package.submodule_search_locations or ()) if package is not None else []
    file = next((path for folder in folders if (path := Path(folder) / BUNNY_FILE).is_file()), None)
    if file is None:
        raise InputError(
            f"shape bunny: it is read from Warp's {BUNNY_FILE}, which is not here; pip install 'warp-lang>=1.19,<2'"
        )
    before = set(bpy.data.objects)
    bpy.ops.wm.usd_import(filepath=str(file))
    added = set(bpy.data.objects) - before
    bunny = next(thing for thing in added if thing.type == "MESH")
    mesh = bunny.data
    points = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.vertices.foreach_get("co", points.ravel())
    world_from_object = np.array(bunny.matrix_world)
    points = points @ world_from_object[:3, :3].T
    low, high = points.min(axis=0), points.max(axis=0)
    points = (points - [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]]) * (BUNNY_WIDTH / (high[0] - low[0]))
    mesh.vertices.foreach_set("co", points.astype(np.float32).ravel())
    mesh.update()
    bunny.matrix_world.identity()
    for thing in added - {bunny}:
        bpy.data.objects.remove(thing)
    return bunny
