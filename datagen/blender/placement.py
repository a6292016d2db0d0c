"""Where objects stand."""

import bpy
import numpy as np
from mathutils import Matrix

TOLERANCE = 1e-5


def place(thing: bpy.types.Object, world_from_object: Matrix) -> None:
    """Put an object without a parent where ``world_from_object`` takes it.

    What no location, rotation and scale can do, a shear as of a turned part of a stretched object, is done to its mesh.
    """
    thing.matrix_world = world_from_object
    # The basis is put together anew from location, rotation and scale; the world's matrix is what was just set.
    wanted, achieved = np.array(world_from_object), np.array(thing.matrix_basis)
    if isinstance(thing.data, bpy.types.Mesh) and np.abs(achieved - wanted).max() > TOLERANCE * np.abs(wanted).max():
        thing.data = thing.data.copy()
        thing.data.transform(world_from_object)
        if np.linalg.det(wanted[:3, :3]) < 0:  # a mirror image, whose faces would look inwards
            thing.data.flip_normals()
        thing.matrix_world = Matrix.Identity(4)
