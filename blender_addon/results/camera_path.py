"""The camera's path as one object."""

from collections.abc import Sequence

import bpy
import numpy as np

from ..files.reconstruction_files import FusedFrame
from .emission_material import colored_wire
from .wire_curve import create_wire, render_as_tubes

PATH_COLOR_LINEAR = (0.01, 0.16, 0.55)


def create_path_object(name: str, trajectory: Sequence[FusedFrame], *, radius: float) -> bpy.types.Object:
    """Return a new curve object through the camera positions of ``trajectory``, in its order, units and frame.

    One curve stays light whatever the number of frames, where an object for each would slow Blender down.
    """
    positions_world = np.array([frame.world_from_camera[:3, 3] for frame in trajectory])
    path = bpy.data.objects.new(name, create_wire(name, [positions_world]))
    render_as_tubes(path, radius=radius, material=colored_wire(name, PATH_COLOR_LINEAR))
    return path
