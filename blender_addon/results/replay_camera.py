"""A keyframed camera that goes the way of the scan again."""

import bpy
import numpy as np

from ..files.dataset_files import color_file
from ..files.reconstruction_files import Pose, Record
from .camera_conversion import CAMERA_OPENCV_FROM_BLENDER, blender_pose
from .f_curves import animate
from .frame_pictures import show_behind
from .scan_camera import new_scan_camera
from .scene_collection import REPLAY_PART, add_part, marker_size, remove_parts


def add_replay(scene: bpy.types.Scene, collection: bpy.types.Collection, record: Record) -> bpy.types.Object:
    """Add a camera with a key at each fused frame, in the place of an earlier one, and make it the scene's.

    Frame n of the scan is n frames after the scene's first one; the scene's last frame becomes that of the scan.
    """
    remove_parts(collection, part=REPLAY_PART)
    camera = new_scan_camera("Scanback replay", record.intrinsics, size=marker_size(collection))
    add_part(collection, REPLAY_PART, [camera])
    numbers = np.array([fused.frame for fused in record.trajectory], dtype=float)
    order = np.argsort(numbers, kind="stable")
    numbers = numbers[order]
    poses = [record.trajectory[i].world_from_camera for i in order]
    camera.rotation_mode = "QUATERNION"
    camera.matrix_world = blender_pose(poses[0])
    start = scene.frame_start
    animate(camera, start + numbers, _channels(poses))
    scene.frame_end = max(start + int(numbers[-1]), start)
    _show_sequence(camera.data, record, [int(number) for number in numbers], start)
    scene.camera = camera
    return camera


def _channels(poses: list[Pose]) -> dict[str, np.ndarray]:
    rotations = [blender_pose(pose).to_quaternion() for pose in poses]
    for i in range(1, len(rotations)):
        if rotations[i].dot(rotations[i - 1]) < 0:
            rotations[i].negate()
    return {
        "location": np.array([(pose @ CAMERA_OPENCV_FROM_BLENDER)[:3, 3] for pose in poses]),
        "rotation_quaternion": np.array([tuple(rotation) for rotation in rotations]),
    }


def _show_sequence(camera_data: bpy.types.Camera, record: Record, numbers: list[int], start: int) -> None:
    """Let the frames' pictures run behind the camera, where a file for each number from the first to the last is there.

    Blender takes the picture numbered by the scene's frame, less its first one, plus one, plus the offset.
    """
    whole = range(numbers[0], numbers[-1] + 1)
    files = [color_file(record.dataset, number) for number in whole]
    if any(file is None for file in files):
        return
    show_behind(camera_data, files[0])
    background = camera_data.background_images[0]
    background.image = background.image.copy()  # that of the first frame alone may be shown elsewhere
    background.image.name = "Scanback frames"
    background.image.source = "SEQUENCE"
    user = background.image_user
    user.frame_start = start + numbers[0]
    user.frame_duration = len(whole)
    user.frame_offset = numbers[0] - 1
    user.use_auto_refresh = True
