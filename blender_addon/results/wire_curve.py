"""Lines that render: poly curves with a thin round section, any number of them in one object."""

from collections.abc import Sequence

import bpy
import numpy as np
from numpy.typing import NDArray


def create_wire(
    name: str,
    polylines: Sequence[NDArray[np.floating]],
    *,
    radius_m: float,
    material: bpy.types.Material,
    closed: Sequence[bool] | None = None,
) -> bpy.types.Curve:
    """Return new curve data that draws ``polylines``, each (N, 3), closed where ``closed`` says so."""
    curve = bpy.data.curves.new(name, "CURVE")
    curve.dimensions = "3D"
    curve.bevel_depth = radius_m
    curve.bevel_resolution = 1
    curve.use_fill_caps = True
    for index, points in enumerate(polylines):
        spline = curve.splines.new("POLY")
        spline.points.add(len(points) - 1)
        spline.points.foreach_set("co", np.column_stack([points, np.ones(len(points))]).ravel())
        spline.use_cyclic_u = closed is not None and closed[index]
    curve.materials.append(material)
    return curve
