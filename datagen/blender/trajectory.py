"""Camera keyframes as Blender F-curves, so that the motion can be seen and edited in Blender as any other."""

from collections.abc import Sequence
from itertools import pairwise

import bpy
import numpy as np
from numpy.typing import NDArray

from datagen.errors import InputError
from datagen.scene_spec.keyframes import Keyframe

INTERPOLATION = {"linear": "LINEAR", "smooth": "BEZIER"}
SMALLEST_KEY_SPACING = 0.02
"""In frames: Blender takes keys within 0.01 frames of each other for one."""


def animate_camera(camera: bpy.types.Object, keyframes: Sequence[Keyframe], *, frames: int) -> None:
    """Put F-curves on ``camera`` that take it through ``keyframes`` from frame 0 to frame ``frames`` − 1.

    Keys that look at a point move an empty which a Track To constraint keeps in the image's centre; keys with a
    quaternion turn the camera itself. Raises InputError where two keys fall together at so few frames.
    """
    key_frames = [key.time * max(frames - 1, 1) for key in keyframes]
    for earlier, later in pairwise(key_frames):
        if later - earlier < SMALLEST_KEY_SPACING:
            raise InputError(
                f"keyframes: two of them lie {later - earlier:.3g} frames apart at {frames} frames, "
                f"at least {SMALLEST_KEY_SPACING} is needed; render more frames or set fewer keys"
            )
    interpolation = [INTERPOLATION[key.interpolation] for key in keyframes]
    positions = np.array([key.position for key in keyframes])
    _add_curves(camera, "location", key_frames, positions, interpolation)
    targets = [key.look_at for key in keyframes if key.look_at is not None]
    if targets:
        target = _track_target(camera)
        _add_curves(target, "location", key_frames, np.array(targets), interpolation)
    else:
        quaternions = [key.quat_wxyz for key in keyframes if key.quat_wxyz is not None]
        camera.rotation_mode = "QUATERNION"
        _add_curves(camera, "rotation_quaternion", key_frames, blender_quaternions(quaternions), interpolation)


def blender_quaternions(quats_wxyz: Sequence[Sequence[float]]) -> NDArray[np.float64]:
    """Return rotations of Blender's camera axes (N, 4) for world_from_camera quaternions (N, 4) of OpenCV axes.

    A half turn about x follows each: q · (0, 1, 0, 0). Of q and −q, the same rotation, each takes the sign that lies
    nearer its predecessor, because F-curves interpolate the four numbers one by one.
    """
    w, x, y, z = np.asarray(quats_wxyz, dtype=np.float64).T
    result = np.stack([-x, w, z, -y], axis=-1)
    result /= np.linalg.norm(result, axis=-1, keepdims=True)
    for i in range(1, len(result)):
        if result[i] @ result[i - 1] < 0:
            result[i] = -result[i]
    return result


def f_curves(animated: bpy.types.Object) -> list[bpy.types.FCurve]:
    """Return an object's F-curves, which lie in its action's slot since Blender 4.4."""
    animation = animated.animation_data
    if animation is None or animation.action is None:
        return []
    bags = (strip.channelbag(animation.action_slot) for layer in animation.action.layers for strip in layer.strips)
    return [curve for bag in bags if bag is not None for curve in bag.fcurves]


def _track_target(camera: bpy.types.Object) -> bpy.types.Object:
    target = bpy.data.objects.new("Camera target", None)
    for collection in camera.users_collection:
        collection.objects.link(target)
    constraint = camera.constraints.new("TRACK_TO")
    constraint.target = target
    constraint.track_axis = "TRACK_NEGATIVE_Z"
    constraint.up_axis = "UP_Y"
    return target


def _add_curves(
    animated: bpy.types.Object,
    data_path: str,
    key_frames: Sequence[float],
    values: NDArray[np.float64],
    interpolation: Sequence[str],
) -> None:
    """Key ``values`` (N, components); smooth keys get automatic handles, which keep the speed through a key.

    Where the motion ends as it began, the curves repeat, so that smooth motion runs through the closing key as through
    any other instead of slowing down at it.
    """
    for frame, value in zip(key_frames, values, strict=True):
        setattr(animated, data_path, value)
        animated.keyframe_insert(data_path, frame=frame)
    closed = len(values) > 2 and np.allclose(values[0], values[-1], rtol=0, atol=1e-9)
    for curve in f_curves(animated):
        if curve.data_path != data_path:
            continue
        if closed:
            curve.modifiers.new("CYCLES")
        for key, name in zip(curve.keyframe_points, interpolation, strict=True):
            key.interpolation = name
            key.handle_left_type = key.handle_right_type = "AUTO"
        curve.update()
