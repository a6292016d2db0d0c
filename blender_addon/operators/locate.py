"""Locate: where a view was taken from."""

# mypy: disable-error-code="valid-type,misc"
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

from ..errors import ReconstructionError
from ..files.reconstruction_files import Pose
from ..results.camera_conversion import CAMERA_OPENCV_FROM_BLENDER
from ..scan_folder import scan_folder
from ..settings import FolderProperties, LocateProperties, chosen
from ..steps.locate import LocateQuery, locate_work
from ..steps.scene_reference import remember
from .job_operator import JobOperator, WorkMaker


class SCANBACK_OT_locate(JobOperator, FolderProperties, LocateProperties, bpy.types.Operator):  # noqa: N801
    """Locates a view."""

    bl_idname = "scanback.locate"
    bl_label = "Locate"
    bl_description = "Find the fused frame that is nearest to a view, by shape alone, and put a camera there"
    title = "Locate"

    def prepare(self, context: Any) -> WorkMaker:
        """Take the view's place where it is looked through."""
        scene = context.scene
        settings = chosen(self, scene.scanback.locate, LocateProperties)
        for name in ("color_file", "depth_file"):
            settings[name] = bpy.path.abspath(settings[name])
        view = None
        if settings["query"] == "CAMERA":
            view = _pose_of_camera(scene)
        elif settings["query"] == "VIEW":
            view = _pose_of_viewport(context)
        query = LocateQuery(settings=settings, view=view)
        return locate_work(remember(scene), scan_folder(scene, self.folder), query)


def _pose_of_camera(scene: Any) -> Pose:
    if scene.camera is None:
        raise ReconstructionError("The scene has no camera; add one, or locate something else")
    location, rotation, _ = scene.camera.matrix_world.decompose()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.to_matrix(), location
    return pose @ CAMERA_OPENCV_FROM_BLENDER


def _pose_of_viewport(context: Any) -> Pose:
    space = context.space_data
    if space is None or space.type != "VIEW_3D":
        raise ReconstructionError("There is no 3D viewport here; locate the scene's camera instead")
    region = space.region_3d
    pose = np.array(region.view_matrix.inverted())
    if region.view_perspective == "ORTHO":  # its matrix is at what is looked at: this is where perspective looks from
        pose[:3, 3] = region.view_location + region.view_distance * (region.view_rotation @ Vector((0, 0, 1)))
    return pose @ CAMERA_OPENCV_FROM_BLENDER


def register() -> None:
    """Add the operator."""
    bpy.utils.register_class(SCANBACK_OT_locate)


def unregister() -> None:
    """Take it away."""
    bpy.utils.unregister_class(SCANBACK_OT_locate)
