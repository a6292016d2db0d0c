"""The objects of a scene file in Blender: their parts, places, materials and indices."""

import math
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import bpy
import numpy as np
from mathutils import Euler, Matrix, Vector
from numpy.typing import NDArray

from datagen.blender.imports import append_models
from datagen.blender.materials import UV_SURFACE
from datagen.blender.placement import place
from datagen.blender.shapes import UV_METRES, UV_UNIT, shape_mesh
from datagen.scene_spec.materials import MaterialSettings
from datagen.scene_spec.objects import ObjectSettings, PartSettings
from datagen.scene_spec.textures import TextureSettings

LARGEST_SHIFT = 7.3
"""Of a repeating picture, in its own lengths, so that two parts of one wood do not show the same grain."""


def add_object(
    scene: bpy.types.Scene,
    settings: ObjectSettings,
    *,
    index: int,
    materials: Mapping[str, bpy.types.Material],
    declared: Mapping[str, MaterialSettings],
    libraries: Mapping[PartSettings, Path],
) -> None:
    """Add an object's parts to ``scene``, all with the pass index ``index``.

    ``libraries`` says where the files that parts name lie prepared (see ``imports``). Several parts are named after the
    object and their number.
    """
    world_from_object = _placement(settings)
    for number, part in enumerate(settings.all_parts):
        world_from_part = world_from_object @ _placement(part) if settings.parts else world_from_object
        name = f"{settings.name}.{number}" if settings.parts else settings.name
        if part.file is not None:
            pieces = append_models(scene, libraries[part])
        else:
            pieces = [bpy.data.objects.new(name, shape_mesh(part))]
            scene.collection.objects.link(pieces[0])
        for piece in pieces:
            piece.name = piece.data.name = name
            piece.pass_index = index
            place(piece, world_from_part @ piece.matrix_basis)
            _dress(piece.data, part, materials, declared, grain_seed=zlib.crc32(name.encode()))
            _subdivide(piece, part.subdivision)


def _placement(settings: PartSettings) -> Matrix:
    angles = [math.radians(angle) for angle in settings.rotation_deg]
    return Matrix.LocRotScale(Vector(settings.location), Euler(angles, "XYZ"), Vector(settings.scale))


def _dress(
    mesh: bpy.types.Mesh,
    part: PartSettings,
    materials: Mapping[str, bpy.types.Material],
    declared: Mapping[str, MaterialSettings],
    *,
    grain_seed: int,
) -> None:
    """Give a mesh its part's materials and, where they are textured, places on their pictures."""
    names = [name for name in (part.material, part.inner_material) if name is not None]
    if not names:
        return  # a file with its own materials
    mesh.materials.clear()
    for name in names:
        mesh.materials.append(materials[name])
    if part.file is not None:
        mesh.polygons.foreach_set("material_index", np.zeros(len(mesh.polygons), np.int32))
        if part.smooth:
            mesh.polygons.foreach_set("use_smooth", [True] * len(mesh.polygons))
    textures = [declared[name].texture for name in names]
    if any(texture is not None for texture in textures):
        _add_places(mesh, textures, np.random.default_rng(grain_seed))


def _add_places(mesh: bpy.types.Mesh, textures: Sequence[TextureSettings | None], rng: np.random.Generator) -> None:
    """Add the UV map that textured materials read, from the shape's own maps or else from the sides that faces show."""
    slots = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("material_index", slots)
    sizes = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("loop_total", sizes)
    slot_of_corner = np.repeat(np.minimum(slots, len(textures) - 1), sizes)
    places = np.zeros((len(mesh.loops), 2), np.float32)
    for slot, texture in enumerate(textures):
        if texture is None:
            continue
        on_it = slot_of_corner == slot
        if texture.size is None:
            places[on_it] = _uv_map(mesh, UV_UNIT)[on_it]
        else:
            shift = rng.uniform(0, LARGEST_SHIFT, 2) * (texture.pattern != "print")
            places[on_it] = _uv_map(mesh, UV_METRES)[on_it] / texture.size + shift
    for layer in list(mesh.uv_layers):
        mesh.uv_layers.remove(layer)
    mesh.uv_layers.new(name=UV_SURFACE).uv.foreach_set("vector", places.ravel())


def _uv_map(mesh: bpy.types.Mesh, name: str) -> NDArray[np.float32]:
    """Return a UV map (L, 2); of a mesh without it, that of a box about it, or for "unit" its own first map."""
    places = np.empty((len(mesh.loops), 2), np.float32)
    layer = mesh.uv_layers.get(name)
    if layer is None and name == UV_UNIT and len(mesh.uv_layers):
        layer = mesh.uv_layers[0]
    if layer is not None:
        layer.uv.foreach_get("vector", places.ravel())
        return places
    points = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.vertices.foreach_get("co", points.ravel())
    corners = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    normals = np.empty((len(mesh.polygons), 3), np.float32)
    mesh.polygons.foreach_get("normal", normals.ravel())
    sizes = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("loop_total", sizes)
    axis = np.repeat(np.abs(normals).argmax(axis=1), sizes)
    if name == UV_UNIT:
        low, high = points.min(axis=0), points.max(axis=0)
        points = (points - low) / np.where(high > low, high - low, 1)
    along, up = np.array([1, 0, 0])[axis], np.array([2, 2, 1])[axis]
    return np.stack([points[corners, along], points[corners, up]], axis=-1)


def _subdivide(piece: bpy.types.Object, levels: int) -> None:
    if levels:
        modifier = piece.modifiers.new("Subdivision", "SUBSURF")
        # The same in both, so that the ground truth from the evaluated scene is what Cycles renders.
        modifier.levels = modifier.render_levels = levels
