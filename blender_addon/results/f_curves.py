"""F-curves of a new action, which lie in a slot's channels since Blender 4.4."""

from collections.abc import Mapping
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray


def animate(item: bpy.types.Object, frames: NDArray[np.floating], channels: Mapping[str, NDArray[np.floating]]) -> None:
    """Key properties of ``item`` at ``frames`` (N,) with ``channels`` (N, components), straight between the keys."""
    action = bpy.data.actions.new(item.name)
    curves = _curves_of(action, item)
    for path, values in channels.items():
        for index in range(values.shape[1]):
            curve = curves.new(path, index=index)
            curve.keyframe_points.add(len(frames))
            curve.keyframe_points.foreach_set("co", np.column_stack([frames, values[:, index]]).ravel())
            linear = bpy.types.Keyframe.bl_rna.properties["interpolation"].enum_items["LINEAR"].value
            curve.keyframe_points.foreach_set("interpolation", np.full(len(frames), linear, np.int32))
            curve.update()


def _curves_of(action: bpy.types.Action, item: bpy.types.Object) -> Any:
    animation = item.animation_data_create()
    animation.action = action
    if not hasattr(action, "slots"):
        return action.fcurves
    slot = action.slots.new(id_type="OBJECT", name=item.name)
    animation.action_slot = slot
    strip = action.layers.new("Layer").strips.new(type="KEYFRAME")
    return strip.channelbag(slot, ensure=True).fcurves
