"""A path through keyframes, the same as Blender's F-curves take."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from datagen.errors import InputError
from datagen.scene_spec.keyframes import Handles, Keyframe
from datagen.trajectory.f_curves import KeyedCurves, evaluate
from datagen.trajectory.viewing import look_at_each, poses, rotation_of

Array = NDArray[np.float64]

SMALLEST_KEY_SPACING = 0.02
"""In frames: Blender takes keys within 0.01 frames of each other for one."""


@dataclass(frozen=True, kw_only=True)
class CameraCurves:
    """Curves of the camera's ``position`` and of either the ``target`` that it looks at or its ``quat_wxyz``."""

    position: KeyedCurves
    target: KeyedCurves | None
    quat_wxyz: KeyedCurves | None


def camera_curves(keyframes: Sequence[Keyframe], frames: int) -> CameraCurves:
    """Return the curves of keys whose times 0 to 1 span frame 0 to frame ``frames`` − 1.

    Quaternions are world_from_camera of OpenCV axes, interpolated component by component; of q and −q, the same
    rotation, each key takes the one that lies nearer its predecessor. Raises InputError where two keys fall together
    at so few frames.
    """
    span = max(frames - 1, 1)
    key_frames = np.array([key.time * span for key in keyframes])
    for earlier, later in pairwise(key_frames):
        if later - earlier < SMALLEST_KEY_SPACING:
            raise InputError(
                f"keyframes: two of them lie {later - earlier:.3g} frames apart at {frames} frames, "
                f"at least {SMALLEST_KEY_SPACING} is needed; render more frames or set fewer keys"
            )

    def curves(values: ArrayLike, handles: Sequence[Handles | None], signs: ArrayLike) -> KeyedCurves:
        values = np.asarray(values, dtype=np.float64)
        placed = [
            None if given is None else _placed(given, frame, value, span, sign)
            for given, frame, value, sign in zip(handles, key_frames, values, np.asarray(signs), strict=True)
        ]
        return KeyedCurves(
            key_frames=key_frames,
            values=values,
            interpolation=tuple(key.interpolation for key in keyframes),
            easing=tuple(key.easing for key in keyframes),
            handles=tuple(placed),
        )

    same = np.ones(len(keyframes))
    position = curves([key.position for key in keyframes], [key.position_handles for key in keyframes], same)
    targets = [key.look_at for key in keyframes if key.look_at is not None]
    if targets:
        looking = curves(targets, [key.look_at_handles for key in keyframes], same)
        return CameraCurves(position=position, target=looking, quat_wxyz=None)
    given = np.array([key.quat_wxyz for key in keyframes], dtype=np.float64)
    signs = _nearer_signs(given)
    unit = given / np.linalg.norm(given, axis=1, keepdims=True)
    turning = curves(unit * signs[:, None], [key.quat_wxyz_handles for key in keyframes], signs)
    return CameraCurves(position=position, target=None, quat_wxyz=turning)


def keyframe_path(keyframes: Sequence[Keyframe], frames: int) -> Array:
    """Return world_from_camera (N, 4, 4) of ``frames`` frames. Raises InputError as ``camera_curves`` does."""
    curves = camera_curves(keyframes, frames)
    at = np.arange(frames, dtype=np.float64)
    positions = evaluate(curves.position, at)
    if curves.target is not None:
        return look_at_each(positions, evaluate(curves.target, at))
    assert curves.quat_wxyz is not None
    return poses(rotation_of(evaluate(curves.quat_wxyz, at)).as_matrix(), positions)


def _placed(handles: Handles, key_frame: float, value: Array, span: int, sign: float) -> Array:
    offsets = np.array(handles.both) * (span, sign)
    return np.stack(np.broadcast_arrays(key_frame, value), axis=-1) + offsets


def _nearer_signs(quats: Array) -> Array:
    agree = np.sign(np.einsum("ij,ij->i", quats[1:], quats[:-1]))
    return np.cumprod(np.append(1.0, np.where(agree < 0, -1.0, 1.0)))
