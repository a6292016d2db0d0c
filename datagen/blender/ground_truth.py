"""The surface that was rendered, in world coordinates."""

from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
import trimesh
from numpy.typing import NDArray

from datagen.atomic_write import write_bytes


@dataclass(frozen=True, kw_only=True)
class TriangleMesh:
    """``vertices_world`` (V, 3) float64 and ``triangles`` (T, 3) int32, counter-clockwise from outside."""

    vertices_world: NDArray[np.float64]
    triangles: NDArray[np.int32]


def evaluated_mesh() -> TriangleMesh:
    """Return all mesh objects of Blender's current scene as one mesh in its units, their modifiers applied."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    vertices, triangles, count = [], [], 0
    for instance in depsgraph.object_instances:
        if instance.object.type != "MESH":
            continue
        mesh = instance.object.to_mesh()
        mesh.calc_loop_triangles()
        vertices_object = np.empty((len(mesh.vertices), 3), np.float32)
        mesh.vertices.foreach_get("co", vertices_object.ravel())
        corners = np.empty((len(mesh.loop_triangles), 3), np.int32)
        mesh.loop_triangles.foreach_get("vertices", corners.ravel())
        world_from_object = np.array(instance.matrix_world, dtype=np.float64)
        if np.linalg.det(world_from_object[:3, :3]) < 0:
            corners = corners[:, ::-1]
        vertices.append(vertices_object @ world_from_object[:3, :3].T + world_from_object[:3, 3])
        triangles.append(corners + count)
        count += len(vertices_object)
        instance.object.to_mesh_clear()
    return TriangleMesh(vertices_world=np.concatenate(vertices), triangles=np.concatenate(triangles))


def write_ply(path: Path, mesh: TriangleMesh, *, metres_per_unit: float = 1.0) -> None:
    """Write a mesh, whose unit is so many metres, atomically as binary PLY in metres."""
    shape = trimesh.Trimesh(mesh.vertices_world * metres_per_unit, mesh.triangles, process=False)
    write_bytes(path, shape.export(file_type="ply", encoding="binary"))
