"""The camera's path as Blender F-curves, so that the motion can be seen and edited in Blender as any other."""

from dataclasses import dataclass

import bpy
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from datagen.blender.camera import BLENDER_FROM_OPENCV
from datagen.errors import InputError
from datagen.rigid import rigid
from datagen.scene_spec.trajectory_settings import BlendCameraTrajectory, KeyframeTrajectory, Trajectory
from datagen.trajectory.camera_path import camera_path
from datagen.trajectory.f_curves import KeyedCurves
from datagen.trajectory.keyframe_path import camera_curves
from datagen.trajectory.shake import shaken

INTERPOLATION = {"smooth": "BEZIER"}
"""Of the scene file's names, those that Blender does not have in capitals."""
EASING = {"auto": "AUTO", "in": "EASE_IN", "out": "EASE_OUT", "in-out": "EASE_IN_OUT"}
QUATERNION_ORDER, QUATERNION_SIGNS = [1, 0, 3, 2], np.array([-1.0, 1.0, 1.0, -1.0])
"""A half turn about x from the right, q · (0, 1, 0, 0) = (−x, w, z, −y), turns OpenCV's camera axes into Blender's."""


@dataclass(frozen=True, kw_only=True)
class BlendCamera:
    """A .blend's own camera, and the frames from ``first_frame`` to ``last_frame`` that its animation has."""

    camera: bpy.types.Object
    first_frame: int
    last_frame: int


def find_blend_camera(scene: bpy.types.Scene) -> BlendCamera | None:
    """Return the camera that ``scene`` has from its .blend, before ours takes its place; None where it has none."""
    if scene.camera is None or scene.camera.type != "CAMERA":
        return None
    return BlendCamera(camera=scene.camera, first_frame=scene.frame_start, last_frame=scene.frame_end)


def animate_camera(
    camera: bpy.types.Object,
    settings: Trajectory,
    *,
    frames: int,
    frames_per_second: float,
    seed: int,
    blend_camera: BlendCamera | None = None,
) -> NDArray[np.float64]:
    """Put F-curves on ``camera`` that take it along a trajectory from frame 0 to frame ``frames`` − 1.

    Keyframes become keys: those that look at a point move an empty which a Track To constraint keeps in the image's
    centre, those with a quaternion turn the camera itself. Any other trajectory becomes one key a frame.
    ``blend_camera`` is what ``find_blend_camera`` found. Returns the path world_from_camera (N, 4, 4) as
    computed without Blender; what Blender makes of it departs by single precision. Raises InputError where the
    trajectory cannot be had.
    """
    if isinstance(settings, BlendCameraTrajectory):
        path = _path_of_blend_camera(blend_camera, settings, frames)
        if settings.shake is not None:
            path = shaken(path, settings.shake, frames_per_second=frames_per_second, seed=seed)
    else:
        path = camera_path(settings, frames, frames_per_second, seed)
    if isinstance(settings, KeyframeTrajectory) and settings.shake is None:
        _add_keyframes(camera, settings, frames)
    else:
        _add_key_for_each_frame(camera, path)
    return path


def blender_quaternions(quats_wxyz: ArrayLike) -> NDArray[np.float64]:
    """Return rotations of Blender's camera axes (N, 4) for world_from_camera quaternions (N, 4) of OpenCV axes."""
    return np.asarray(quats_wxyz, dtype=np.float64)[:, QUATERNION_ORDER] * QUATERNION_SIGNS


def f_curves(animated: bpy.types.Object) -> list[bpy.types.FCurve]:
    """Return an object's F-curves, which lie in its action's slot since Blender 4.4."""
    animation = animated.animation_data
    if animation is None or animation.action is None:
        return []
    if not hasattr(animation, "action_slot"):
        return list(animation.action.fcurves)
    bags = (strip.channelbag(animation.action_slot) for layer in animation.action.layers for strip in layer.strips)
    return [curve for bag in bags if bag is not None for curve in bag.fcurves]


def _path_of_blend_camera(
    blend_camera: BlendCamera | None, settings: BlendCameraTrajectory, frames: int
) -> NDArray[np.float64]:
    """Return the path (N, 4, 4) of a .blend's camera, whatever moves it, its frame range stretched over ``frames``."""
    if blend_camera is None:
        raise InputError(
            'trajectory: of type "blend-camera", but the scene has no camera of its own; '
            "set the .blend's active camera, or choose another type of trajectory"
        )
    scene, camera = bpy.context.scene, blend_camera.camera
    first = blend_camera.first_frame if settings.first_frame is None else settings.first_frame
    last = blend_camera.last_frame if settings.last_frame is None else settings.last_frame
    path = np.empty((frames, 4, 4))
    before = scene.frame_current
    for i, time in enumerate(first + (last - first) * np.arange(frames) / max(frames - 1, 1)):
        scene.frame_set(int(np.floor(time)), subframe=float(time - np.floor(time)))
        evaluated = camera.evaluated_get(bpy.context.evaluated_depsgraph_get())
        world_from_blender = np.array(evaluated.matrix_world, dtype=np.float64)
        # Blender renders as if a camera had no scale, which it may have from what it hangs on.
        world_from_blender[:3, :3] /= np.linalg.norm(world_from_blender[:3, :3], axis=0)
        path[i] = rigid(world_from_blender @ BLENDER_FROM_OPENCV, source=f"camera {camera.name!r} at frame {time:g}")
    scene.frame_set(before)
    return path


def _add_keyframes(camera: bpy.types.Object, settings: KeyframeTrajectory, frames: int) -> None:
    curves = camera_curves(settings.keyframes, frames)
    _add_curves(camera, "location", curves.position)
    if curves.target is not None:
        _add_curves(_track_target(camera), "location", curves.target)
    else:
        assert curves.quat_wxyz is not None
        camera.rotation_mode = "QUATERNION"
        _add_curves(camera, "rotation_quaternion", _with_blender_quaternions(curves.quat_wxyz))


def _with_blender_quaternions(curves: KeyedCurves) -> KeyedCurves:
    def turned(handles: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
        if handles is None:
            return None
        frames, values = handles[:, QUATERNION_ORDER, 0], handles[:, QUATERNION_ORDER, 1] * QUATERNION_SIGNS
        return np.stack([frames, values], axis=-1)

    return KeyedCurves(
        key_frames=curves.key_frames,
        values=blender_quaternions(curves.values),
        interpolation=curves.interpolation,
        easing=curves.easing,
        handles=tuple(turned(handles) for handles in curves.handles),
    )


def _track_target(camera: bpy.types.Object) -> bpy.types.Object:
    target = bpy.data.objects.new("Camera target", None)
    for collection in camera.users_collection:
        collection.objects.link(target)
    constraint = camera.constraints.new("TRACK_TO")
    constraint.target = target
    constraint.track_axis = "TRACK_NEGATIVE_Z"
    constraint.up_axis = "UP_Y"
    return target


def _add_curves(animated: bpy.types.Object, data_path: str, curves: KeyedCurves) -> None:
    """Key an object's property as ``curves`` are; what ends as it began repeats, as they do."""
    for frame, value in zip(curves.key_frames, curves.values, strict=True):
        setattr(animated, data_path, value)
        animated.keyframe_insert(data_path, frame=frame)
    for curve in f_curves(animated):
        if curve.data_path != data_path:
            continue
        if curves.is_closed:
            curve.modifiers.new("CYCLES")
        curve.auto_smoothing = "CONT_ACCEL"
        _shape_keys(curve, curves)
        curve.update()


def _shape_keys(curve: bpy.types.FCurve, curves: KeyedCurves) -> None:
    component = curve.array_index
    for i, key in enumerate(curve.keyframe_points):
        key.interpolation = INTERPOLATION.get(curves.interpolation[i], curves.interpolation[i].upper())
        key.easing = EASING[curves.easing[i]]
        key.period = 0.0  # a third of the time to the next key
        if i + 1 < len(curves.values):
            key.amplitude = _just_below(curves.values[i, component], curves.values[i + 1, component])
        given = curves.handles[i]
        if given is None:
            key.handle_left_type = key.handle_right_type = "AUTO"
        else:
            key.handle_left_type = key.handle_right_type = "FREE"
            key.handle_left, key.handle_right = given[:, component]


def _just_below(begin: float, end: float) -> float:
    """Return the amplitude at which an elastic curve swings as far as it goes from ``begin`` to ``end``.

    From the very distance on Blender takes another branch, with the arc sine of a rounded 1.
    """
    distance = np.abs(np.float32(end) - np.float32(begin))
    return float(np.nextafter(distance, np.float32(0)))


def _add_key_for_each_frame(camera: bpy.types.Object, path: NDArray[np.float64]) -> None:
    camera.rotation_mode = "QUATERNION"
    quats = np.roll(Rotation.from_matrix((path @ BLENDER_FROM_OPENCV)[:, :3, :3]).as_quat(), 1, axis=1)
    # Of q and −q, the same rotation, the one that lies nearer the frame before: between frames Blender interpolates.
    agree = np.einsum("ij,ij->i", quats[1:], quats[:-1])
    quats *= np.cumprod(np.append(1.0, np.where(agree < 0, -1.0, 1.0)))[:, None]
    for data_path, values in (("location", path[:, :3, 3]), ("rotation_quaternion", quats)):
        setattr(camera, data_path, values[0])
        camera.keyframe_insert(data_path, frame=0)
        for curve in f_curves(camera):
            if curve.data_path != data_path:
                continue
            points = curve.keyframe_points
            points.add(len(values) - 1)
            points.foreach_set("co", np.column_stack([np.arange(len(values)), values[:, curve.array_index]]).ravel())
            for key in points:
                key.interpolation = "LINEAR"
            curve.update()
